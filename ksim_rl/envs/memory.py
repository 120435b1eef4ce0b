"""What terms keep from step to step: named per-env buffers that are cleared for the rows that reset."""

import math

import torch
from torch import Tensor

# Columns that arenas are allocated in; a wider buffer has one of its own.
ARENA_COLUMNS = 128


class Memory:
    """Named buffers of shape [E, ...], allocated once, cleared by mask, saved with the env.

    Buffers come into being while the env is constructed (each term runs once then). Afterwards the set is frozen:
    an allocation inside a captured step would give another tensor to each replay.

    Buffers that start at zero are columns of few large tensors, one set per dtype, so that a reset clears all of them
    at once. So a buffer need not be contiguous.
    """

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self._num_envs = num_envs
        self._device = device
        self._buffers: dict[str, Tensor] = {}
        self._initial: dict[str, Tensor] = {}
        self._kept: set[str] = set()
        self._arenas: list[Tensor] = []
        self._used: list[int] = []
        self._frozen = False

    def get(
        self,
        name: str,
        *shape: int,
        dtype: torch.dtype = torch.float32,
        keep: bool = False,
        initial: Tensor | None = None,
    ) -> Tensor:
        """Return the buffer `name`, [E, *shape].

        Args:
            name: its name; the buffer is made at the first call.
            shape: beyond the env dim.
            dtype: of its elements.
            keep: leaves it alone when rows reset.
            initial: what it holds at first and after a reset, broadcast to its shape; None means zeros. The tensor is
                read each time, so it may change.

        Raises:
            ValueError: if the buffer exists with another shape or dtype, or is new after construction.
        """
        buffer = self._buffers.get(name)
        if buffer is None:
            if self._frozen:
                raise ValueError(
                    f"memory {name!r} is new after construction: create it on every path of the term"
                )
            if keep or initial is not None:
                buffer = torch.zeros(self._num_envs, *shape, dtype=dtype, device=self._device)
            else:
                buffer = self._columns(shape, dtype)
            self._buffers[name] = buffer
            if keep:
                self._kept.add(name)
            if initial is not None:
                self._initial[name] = initial
                buffer.copy_(initial.expand_as(buffer))
        elif tuple(buffer.shape[1:]) != shape or buffer.dtype != dtype:
            raise ValueError(
                f"memory {name!r} is {buffer.dtype} {tuple(buffer.shape[1:])}, asked for {dtype} {shape}"
            )
        return buffer

    @property
    def is_frozen(self) -> bool:
        """Whether new buffers are refused."""
        return self._frozen

    def freeze(self) -> None:
        """Refuse new buffers from now on, and let the existing ones start anew."""
        self._frozen = True
        for name, buffer in self._buffers.items():
            buffer.zero_()
            if name in self._initial:
                buffer.copy_(self._initial[name].expand_as(buffer))

    def clear(self, mask_E: Tensor) -> None:
        """Let the rows of `mask_E`, bool [E], start anew in each buffer that is not kept."""
        for arena, used in zip(self._arenas, self._used, strict=True):
            arena[:, :used].masked_fill_(mask_E[:, None], 0)
        for name, initial in self._initial.items():
            if name not in self._kept:
                buffer = self._buffers[name]
                mask = mask_E.view(-1, *[1] * (buffer.ndim - 1))
                buffer.copy_(torch.where(mask, initial, buffer))

    def buffers(self) -> dict[str, Tensor]:
        """Return the buffers by name."""
        return dict(self._buffers)

    def _columns(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """Return a view [E, *shape] of columns that nobody else has."""
        width = math.prod(shape)
        for index, arena in enumerate(self._arenas):
            if arena.dtype == dtype and self._used[index] + width <= arena.shape[1]:
                break
        else:
            index = len(self._arenas)
            columns = max(width, ARENA_COLUMNS)
            arena = torch.zeros(self._num_envs, columns, dtype=dtype, device=self._device)
            self._arenas.append(arena)
            self._used.append(0)
        start = self._used[index]
        self._used[index] += width
        found = arena[:, start : start + width]
        return found.unflatten(1, shape) if shape else found[:, 0]
