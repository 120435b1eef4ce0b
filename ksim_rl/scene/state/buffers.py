"""The buffers that terms keep from step to step: with a row per env, or shared by all envs."""

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from ksim_rl.checks import check_known
from ksim_rl.device import recording

# Numbers per env that an arena has room for; a wider buffer has an arena to itself.
ARENA_WIDTH = 128
ENV = "env"
"""The owner of buffers that managers keep, and no term writes."""


class Kept(NamedTuple):
    """A tensor that a part of an env writes each time it runs; without rows, all envs share it."""

    tensor: Tensor
    has_rows: bool


@contextmanager
def only_in_rows(
    mask_E: Bool[Tensor, " E"], kept: Sequence[Kept], *, is_step: bool
) -> Iterator[None]:
    """Let the code inside change kept tensors in the rows of `mask_E` only.

    Tensors that all envs share change in steps only (`is_step`): a reset is no step of the envs that go on.
    """
    # The code inside may write any row; the others are put back afterwards.
    before = [one.tensor.clone() for one in kept]
    yield
    for (tensor, has_rows), old in zip(kept, before, strict=True):
        if has_rows:
            # The mask with as many dims as the tensor, to broadcast over a row.
            rows = mask_E.view(-1, *[1] * (tensor.ndim - 1))
            tensor.copy_(torch.where(rows, tensor, old))
        elif not is_step:
            tensor.copy_(old)


class Arena:
    """One tensor that holds many buffers of one dtype, one after the other, so that one mask clears all of them."""

    def __init__(self, num_envs: int, width: int, dtype: torch.dtype, device: torch.device) -> None:
        self.values = torch.zeros(num_envs * width, dtype=dtype, device=device)
        self._num_envs = num_envs
        self._row_N = torch.zeros(0, dtype=torch.int32, device=device)
        self._used = 0
        self._taken: list[Tensor] = []

    def has_room(self, width: int, dtype: torch.dtype) -> bool:
        """Whether a buffer of this width and dtype fits."""
        return (
            dtype == self.values.dtype
            and self._used + self._num_envs * width <= self.values.numel()
        )

    def take(self, shape: tuple[int, ...]) -> Shaped[Tensor, " E *shape"]:
        """Return a new buffer [E, *shape], contiguous."""
        width = math.prod(shape)
        start = self._used
        self._used = self._used + self._num_envs * width
        rows = torch.arange(self._num_envs, dtype=torch.int32, device=self.values.device)
        # Which env each number belongs to.
        self._row_N = torch.cat((self._row_N, rows.repeat_interleave(width)))
        self._taken.append(self.values[start : self._used].view(self._num_envs, *shape))
        return self._taken[-1]

    def clear(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Zero the rows of `mask_E` in all buffers."""
        # A recorded step fuses kernels by rows, which an arena's flat layout would prevent.
        if recording.is_recording():
            for taken in self._taken:  # each in the kernel that works on its rows
                taken.masked_fill_(mask_E.view(-1, *[1] * (taken.ndim - 1)), 0)
            return
        # One kernel for all buffers of the arena, each number masked by its env's row.
        self.values[: self._used].masked_fill_(mask_E.index_select(0, self._row_N), 0)


class Buffers:
    """Named buffers of shape [E, ...], allocated once, cleared by mask, saved with the env.

    They come into being while the env is constructed (each term runs once then). Afterwards the set is frozen: an
    allocation inside a captured step would give another tensor to each replay. Those that start at zero lie in few
    large tensors, so that a reset clears all of them together.
    """

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self._num_envs = num_envs
        self._device = device
        self._buffers: dict[str, Tensor] = {}
        self._initial: dict[str, Tensor] = {}
        self._kept: set[str] = set()
        self._owners: dict[str, str] = {}
        self._arenas: list[Arena] = []
        self.is_frozen = False

    def get(
        self,
        name: str,
        *shape: int,
        dtype: torch.dtype = torch.float32,
        keep: bool = False,
        initial: Shaped[Tensor, "*initial"] | None = None,
        owner: str = "",
    ) -> Shaped[Tensor, " E *shape"]:
        """Return the buffer `name`; the first call makes it, later ones must agree in shape and dtype.

        `keep` leaves it alone when rows reset; `initial` (read each time, so it may change) is its value at first
        and after a reset, else zeros. `owner` is the scope of the one part that writes it, `ENV` for a manager, and
        empty for buffers that events and actions write for all to read. A ValueError where it differs from the existing
        one, or is new after construction.
        """
        buffer = self._buffers.get(name)
        # The first call makes it, while the env is constructed.
        if buffer is None:
            if self.is_frozen:
                raise ValueError(
                    f"buffer {name!r} is new after construction: create it on every path of the term"
                )
            # An arena zeroes all that it holds: kept buffers and those with initial values stand by
            # themselves.
            if keep or initial is not None:
                buffer = torch.zeros(self._num_envs, *shape, dtype=dtype, device=self._device)
            else:
                buffer = self._arena(math.prod(shape), dtype).take(shape)
            self._buffers[name] = buffer
            self._owners[name] = owner
            if keep:
                self._kept.add(name)
            if initial is not None:
                self._initial[name] = initial
                buffer.copy_(initial.expand_as(buffer))
        # Two terms that use one name for different things would overwrite each other.
        elif tuple(buffer.shape[1:]) != shape or buffer.dtype != dtype:
            raise ValueError(
                f"buffer {name!r} is {buffer.dtype} {tuple(buffer.shape[1:])}, asked for {dtype} {shape}"
            )
        return buffer

    def freeze(self) -> None:
        """Refuse new buffers from now on, and let the existing ones start again."""
        self.is_frozen = True
        for name, buffer in self._buffers.items():
            # Construction has run each term once, which left its traces here.
            buffer.zero_()
            if name in self._initial:
                buffer.copy_(self._initial[name].expand_as(buffer))

    def clear(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Let the rows of `mask_E` start again in each buffer that is not kept."""
        for arena in self._arenas:
            arena.clear(mask_E)
        # Arenas have cleared all others already.
        for name, initial in self._initial.items():
            if name not in self._kept:
                buffer = self._buffers[name]
                mask = mask_E.view(-1, *[1] * (buffer.ndim - 1))
                buffer.copy_(torch.where(mask, initial, buffer))

    def by_name(self) -> dict[str, Shaped[Tensor, " E *?shape"]]:
        """Return the buffers by name."""
        return dict(self._buffers)

    def owner(self, name: str) -> str:
        """Return the owner of a buffer, as it was given when the buffer was made."""
        return self._owners[name]

    def is_kept(self, name: str) -> bool:
        """Whether resets leave a buffer alone."""
        return name in self._kept

    def _arena(self, width: int, dtype: torch.dtype) -> Arena:
        """Return an arena with room for so many numbers per env."""
        # First fit: small buffers fill the rest of earlier arenas.
        if not any(arena.has_room(width, dtype) for arena in self._arenas):
            self._arenas.append(Arena(self._num_envs, max(width, ARENA_WIDTH), dtype, self._device))
        return next(arena for arena in self._arenas if arena.has_room(width, dtype))


class SharedValues:
    """Named float32 tensors without an env dim, saved with the env; as `Buffers`, but no reset touches them."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._tensors: dict[str, Tensor] = {}
        self._initial: dict[str, Tensor] = {}
        self._owners: dict[str, str] = {}
        self._frozen = False

    def get(
        self,
        name: str,
        initial: float | Sequence[float] | Sequence[Sequence[float]],
        *,
        owner: str = "",
    ) -> Float[Tensor, "*shape"]:
        """Return the tensor `name`, always the same, which starts at `initial`; a ValueError if it is new too late.

        `owner` is the scope of the one part that writes it; empty for values that curricula write.
        """
        tensor = self._tensors.get(name)
        if tensor is None:
            if self._frozen:
                raise ValueError(
                    f"shared value {name!r} is new after construction: ask for it on every path"
                )
            # A tensor made in inference mode could not be written in place outside of it later.
            with torch.inference_mode(False):
                tensor = torch.tensor(initial, dtype=torch.float32, device=self._device)
                self._initial[name] = tensor.clone()
            self._tensors[name] = tensor
            self._owners[name] = owner
        return tensor

    def freeze(self) -> None:
        """Refuse new tensors from now on, and let the terms' own start again: terms ran while the env was made."""
        self._frozen = True
        for name, tensor in self._tensors.items():
            # Without an owner it is a curriculum's, which has not run yet.
            if self._owners[name]:
                tensor.copy_(self._initial[name])

    def by_name(self) -> dict[str, Float[Tensor, "*?shape"]]:
        """Return the tensors by name."""
        return dict(self._tensors)

    def owner(self, name: str) -> str:
        """Return the owner of a tensor, as it was given when the tensor was made."""
        return self._owners[name]


class ActuatorParams:
    """Buffers by name (`stiffness`, `effort_limit`, ...), float32 [E, L], in the order of `joint_pos_EL`.

    They start at the numbers of the config, are read at each substep, saved with the env, and stay when rows reset; so
    an event may write them in place, for some rows, at any moment. Joints without such a number have 0 there, unread.
    """

    def __init__(self, buffers: Buffers, joint_names: Sequence[str], device: torch.device) -> None:
        self._all_buffers = buffers
        self._joint_names = list(joint_names)
        self._device = device
        self._buffers: dict[str, Tensor] = {}
        self._nominal: dict[str, Tensor] = {}
        self._owners: dict[str, dict[int, float]] = {}

    def add(self, name: str, joints: Sequence[int], value: float) -> None:
        """Give some joints a number; during construction only."""
        if name not in self._buffers:
            # Zero in the columns of joints without this number; these are never read.
            nominal_L = self._nominal[name] = torch.zeros(
                len(self._joint_names), device=self._device
            )
            self._buffers[name] = self._all_buffers.get(
                # Kept over resets: an event's draw at startup must survive them.
                f"actuators.{name}_EL",
                len(self._joint_names),
                keep=True,
                initial=nominal_L,
            )
        # The nominal numbers are the buffer's initial value; the buffer itself was filled before they changed.
        self._nominal[name][list(joints)] = value
        self._buffers[name].copy_(self._nominal[name].expand_as(self._buffers[name]))
        self._owners.setdefault(name, {}).update(dict.fromkeys(joints, value))

    def get(self, name: str, joints: Collection[int] = ()) -> Float[Tensor, "E L"]:
        """Return the present numbers, [E, L]; an error if one of `joints` has none."""
        self._check(name, joints)
        return self._buffers[name]

    def nominal(self, name: str) -> Float[Tensor, " L"]:
        """Return the numbers of the config, [L]."""
        self._check(name, ())
        return self._nominal[name]

    def joints(self, name: str, *, finite: bool = False) -> frozenset[int]:
        """Return the joints that have this number; with `finite`, those whose number in the config is finite."""
        owners = self._owners.get(name, {})
        return frozenset(
            joint for joint, value in owners.items() if not finite or math.isfinite(value)
        )

    def _check(self, name: str, joints: Collection[int]) -> None:
        check_known("parameter of explicit actuators", name, self._buffers)
        for joint in joints:
            if joint not in self._owners[name]:
                raise ValueError(
                    f"the actuator of joint {self._joint_names[joint]!r} has no parameter {name!r}: built-in "
                    "actuators have the model fields actuator_gainprm, actuator_biasprm and actuator_forcerange"
                )
