"""How much of the past an observation shows."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class HistoryCfg:
    """The last `length` frames, oldest first.

    Args:
        length: number of frames.
        stride: env steps from one frame to the next.
        flat: True puts frame after frame into one vector; False stacks them along a dim of their own.
    """

    length: int
    stride: int = 1
    flat: bool = True

    def __post_init__(self) -> None:
        for field, unit in (("length", "frames"), ("stride", "env steps")):
            value = getattr(self, field)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{field}={value!r}: expected a whole number of {unit} of at least 1")
        if not isinstance(self.flat, bool):
            raise ValueError(f"flat={self.flat!r}: expected True or False")
