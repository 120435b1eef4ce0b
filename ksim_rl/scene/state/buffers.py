"""This module holds what terms keep from step to step: buffers with a row per env, and values that all envs share."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

# Numbers per env that an arena has room for; a wider buffer has one of its own.
ARENA_WIDTH = 128


class Arena:
    """One tensor that holds many buffers of one dtype, one after the other, so that one mask clears all of them."""

    def __init__(self, num_envs: int, width: int, dtype: torch.dtype, device: torch.device) -> None:
        self.values = torch.zeros(num_envs * width, dtype=dtype, device=device)
        self._num_envs = num_envs
        self._row_N = torch.zeros(0, dtype=torch.int32, device=device)
        self._used = 0

    def has_room(self, width: int, dtype: torch.dtype) -> bool:
        """Whether a buffer of this width and dtype fits."""
        return dtype == self.values.dtype and self._used + self._num_envs * width <= self.values.numel()

    def take(self, shape: tuple[int, ...]) -> Shaped[Tensor, " E *shape"]:
        """Return a buffer [E, *shape], contiguous, that nobody else has."""
        width = math.prod(shape)
        start, self._used = self._used, self._used + self._num_envs * width
        rows = torch.arange(self._num_envs, dtype=torch.int32, device=self.values.device)
        # Which env each number belongs to.
        self._row_N = torch.cat((self._row_N, rows.repeat_interleave(width)))
        return self.values[start : self._used].view(self._num_envs, *shape)

    def clear(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Zero the rows of `mask_E`, bool [E], in all buffers."""
        self.values[: self._used].masked_fill_(mask_E.index_select(0, self._row_N), 0)


class Buffers:
    """Named buffers of shape [E, ...], allocated once, cleared by mask, saved with the env.

    Buffers come into being while the env is constructed (each term runs once then). Afterwards the set is frozen:
    an allocation inside a captured step would give another tensor to each replay.

    Buffers that start at zero lie in few large tensors, so that a reset clears all of them at once.
    """

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self._num_envs = num_envs
        self._device = device
        self._buffers: dict[str, Tensor] = {}
        self._initial: dict[str, Tensor] = {}
        self._kept: set[str] = set()
        self._arenas: list[Arena] = []
        self._frozen = False

    def get(
        self,
        name: str,
        *shape: int,
        dtype: torch.dtype = torch.float32,
        keep: bool = False,
        initial: Shaped[Tensor, "*initial"] | None = None,
    ) -> Shaped[Tensor, " E *shape"]:
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
                    f"buffer {name!r} is new after construction: create it on every path of the term"
                )
            if keep or initial is not None:
                buffer = torch.zeros(self._num_envs, *shape, dtype=dtype, device=self._device)
            else:
                buffer = self._arena(math.prod(shape), dtype).take(shape)
            self._buffers[name] = buffer
            if keep:
                self._kept.add(name)
            if initial is not None:
                self._initial[name] = initial
                buffer.copy_(initial.expand_as(buffer))
        elif tuple(buffer.shape[1:]) != shape or buffer.dtype != dtype:
            raise ValueError(
                f"buffer {name!r} is {buffer.dtype} {tuple(buffer.shape[1:])}, asked for {dtype} {shape}"
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

    def clear(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Let the rows of `mask_E`, bool [E], start anew in each buffer that is not kept."""
        for arena in self._arenas:
            arena.clear(mask_E)
        for name, initial in self._initial.items():
            if name not in self._kept:
                buffer = self._buffers[name]
                mask = mask_E.view(-1, *[1] * (buffer.ndim - 1))
                buffer.copy_(torch.where(mask, initial, buffer))

    def by_name(self) -> dict[str, Shaped[Tensor, " E *?shape"]]:
        """Return the buffers by name."""
        return dict(self._buffers)

    def _arena(self, width: int, dtype: torch.dtype) -> Arena:
        """Return an arena with room for so many numbers per env."""
        for arena in self._arenas:
            if arena.has_room(width, dtype):
                return arena
        made = Arena(self._num_envs, max(width, ARENA_WIDTH), dtype, self._device)
        self._arenas.append(made)
        return made


class SharedValues:
    """Named float32 tensors without an env dim, saved with the env.

    Like `Buffers` they come into being while the env is constructed; unlike those they keep
    what they start with, and no reset touches them.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._tensors: dict[str, Tensor] = {}
        self._frozen = False

    def get(
        self, name: str, initial: float | Sequence[float] | Sequence[Sequence[float]]
    ) -> Float[Tensor, "*shape"]:
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

    def by_name(self) -> dict[str, Float[Tensor, "*?shape"]]:
        """Return the tensors by name."""
        return dict(self._tensors)
