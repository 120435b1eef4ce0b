"""What terms keep from step to step: named per-env buffers that are cleared for the rows that reset."""

import torch
from torch import Tensor


class Memory:
    """Named buffers of shape [E, ...], allocated once, cleared by mask, saved with the env.

    Buffers come into being while the env is constructed (each term runs once then). Afterwards the set is frozen:
    an allocation inside a captured step would give another tensor to each replay.
    """

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self._num_envs = num_envs
        self._device = device
        self._buffers: dict[str, Tensor] = {}
        self._cleared: list[Tensor] = []
        self._frozen = False

    def get(self, name: str, *shape: int, dtype: torch.dtype = torch.float32, keep: bool = False) -> Tensor:
        """Return the buffer `name`, zeros [E, *shape] at first; `keep` leaves it alone when rows reset.

        Raises:
            ValueError: if the buffer exists with another shape or dtype, or is new after construction.
        """
        buffer = self._buffers.get(name)
        if buffer is None:
            if self._frozen:
                raise ValueError(f"memory {name!r} is new after construction: create it on every path of the term")
            buffer = torch.zeros(self._num_envs, *shape, dtype=dtype, device=self._device)
            self._buffers[name] = buffer
            if not keep:
                self._cleared.append(buffer)
        elif tuple(buffer.shape[1:]) != shape or buffer.dtype != dtype:
            raise ValueError(f"memory {name!r} is {buffer.dtype} {tuple(buffer.shape[1:])}, asked for {dtype} {shape}")
        return buffer

    def freeze(self) -> None:
        """Refuse new buffers from now on, and zero the existing ones."""
        self._frozen = True
        for buffer in self._buffers.values():
            buffer.zero_()

    def clear(self, mask_E: Tensor) -> None:
        """Zero the rows of `mask_E`, bool [E], in each buffer that is not kept."""
        for buffer in self._cleared:
            buffer.masked_fill_(mask_E.view(-1, *[1] * (buffer.ndim - 1)), 0)

    def buffers(self) -> dict[str, Tensor]:
        """Return the buffers by name."""
        return dict(self._buffers)
