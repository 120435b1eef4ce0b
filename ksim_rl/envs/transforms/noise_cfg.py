"""Noise distributions, as parameters of `ObservationNoise` and of an observation group's terms."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from ksim_rl import checks

PerDim = float | Sequence[float]
"""One number, or one per element of the (flattened) observation."""


@dataclass(frozen=True, kw_only=True)
class NoiseCfg:
    """What all noise has in common.

    Args:
        operation: "add" (observation + noise) or "multiply" (observation * noise).
        bias: a further noise, drawn at each reset and held for the episode (an encoder's offset); its own operation
            applies, before the noise.
    """

    operation: Literal["add", "multiply"] = "add"
    bias: "NoiseCfg | None" = None

    def __post_init__(self) -> None:
        checks.check_choice(f"{type(self).__name__}.operation", self.operation, ("add", "multiply"))
        if self.bias is not None and self.bias.bias is not None:
            raise ValueError(f"{type(self).__name__}.bias={self.bias!r}: a bias has no bias of its own")

    def _check(self, field: str, *, low: float | None = None) -> tuple[float, ...]:
        value = getattr(self, field)
        numbers = tuple(value) if isinstance(value, Sequence) else (value,)
        for index, number in enumerate(numbers):
            name = f"{type(self).__name__}.{field}" + (f"[{index}]" if isinstance(value, Sequence) else "")
            checks.check_in_range(name, number, low=low)
        return numbers


@dataclass(frozen=True, kw_only=True)
class UniformNoise(NoiseCfg):
    """Noise uniform on [low, high)."""

    low: PerDim
    high: PerDim

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self._check("low"), self._check("high")
        if len(low) != len(high) and 1 not in (len(low), len(high)):
            raise ValueError(f"UniformNoise.low has {len(low)} numbers and high has {len(high)}")
        width = max(len(low), len(high))
        for index in range(width):
            pair = low[index % len(low)], high[index % len(high)]
            checks.check_pair(f"UniformNoise(low, high)[{index}]", pair)


@dataclass(frozen=True, kw_only=True)
class GaussianNoise(NoiseCfg):
    """Normal noise."""

    std: PerDim
    mean: PerDim = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check("std", low=0.0)
        self._check("mean")


@dataclass(frozen=True, kw_only=True)
class ConstantNoise(NoiseCfg):
    """The same value always."""

    value: PerDim

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check("value")
