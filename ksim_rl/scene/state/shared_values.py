"""Device values that all envs share and that change while an env runs: ranges of commands, levels, counters."""

from collections.abc import Sequence

import torch
from torch import Tensor


class SharedValues:
    """Named float32 tensors without an env dim, saved with the env.

    Like the per-env buffers of `Memory` they come into being while the env is constructed; unlike those they keep
    what they start with, and no reset touches them.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._tensors: dict[str, Tensor] = {}
        self._frozen = False

    def get(self, name: str, initial: float | Sequence[float] | Sequence[Sequence[float]]) -> Tensor:
        """Return the tensor `name`, which starts at `initial` and has its shape; the same tensor at each call.

        Raises:
            ValueError: if it is new after construction.
        """
        tensor = self._tensors.get(name)
        if tensor is None:
            if self._frozen:
                raise ValueError(f"shared value {name!r} is new after construction: ask for it on every path")
            with torch.inference_mode(False):
                tensor = torch.tensor(initial, dtype=torch.float32, device=self._device)
            self._tensors[name] = tensor
        return tensor

    def freeze(self) -> None:
        """Refuse new tensors from now on."""
        self._frozen = True

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by name."""
        return dict(self._tensors)
