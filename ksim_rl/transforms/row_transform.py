"""The bases of transforms with state per env: buffers, random draws, a level to follow."""

import functools
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, ClassVar, NoReturn, Self, TypeVar

import torch
from jaxtyping import Float32, Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform

from ksim_rl import checks
from ksim_rl.device import random
from ksim_rl.device.state_tree import State
from ksim_rl.transforms import upstream
from ksim_rl.transforms.checked_keys import CheckedKeys, Keys
from ksim_rl.transforms.specs import Device

Held = TypeVar("Held", bound=Transform)
_NO_SEED = -(1 << 63)


class RowTransform(CheckedKeys, ABC):
    """Base of transforms with state per env row.

    All state lives in buffers that are changed in place. Those sized by the env are made when the env first asks for
    its specs or resets, never later, so a captured step keeps its addresses. Subclasses name them by `_register_rows`,
    make them as they transform the specs, by `_size_rows` and `_size_buffer`, and begin episodes in `_begin`.
    """

    num_rows = 0
    _row_device: Device = None

    def _register_rows(self, *names: str) -> None:
        """Name buffers that the env will size."""
        for name in names:
            # None is a buffer without memory: a `state_dict` leaves it out until the env sizes it.
            self.register_buffer(name, None)

    def _per_key(self, name: str) -> list[str]:
        """Return the names of buffers that exist once per key."""
        return [f"{name}_{index}" for index in range(len(self.in_keys or self.in_keys_inv))]

    def _size_rows(self, specs: Composite) -> None:
        """Take note of the number of rows; bases make their buffers here."""
        self.num_rows = specs.shape.numel()
        self._row_device = specs.device

    def _size_buffer(self, name: str, dtype: torch.dtype, leaf: Sequence[int] = ()) -> None:
        """Make a zero buffer [E, *leaf], unless there is one of that shape and dtype already."""
        present = self._buffers[name]
        shape = (self.num_rows, *leaf)
        # Kept where it fits: episodes go on when TorchRL asks for the specs again.
        if present is None or present.shape != shape or present.dtype != dtype:
            self._buffers[name] = torch.zeros(shape, dtype=dtype, device=self._row_device)

    def _size_leaves(
        self,
        name: str,
        specs: Composite,
        leaves: Sequence[TensorSpec],
        dtype: torch.dtype | None = None,
    ) -> None:
        """Make a buffer `<name>_<index>` per leaf, in its dtype or another."""
        for index, spec in enumerate(leaves):
            self._size_buffer(f"{name}_{index}", dtype or spec.dtype, spec.shape[specs.ndim :])

    def _sized(self) -> dict[str, Any]:
        """Return the buffers by name, which answer faster than the module; the specs make those that are missing.

        TorchRL may reset or resume an env before it asks for them.
        """
        # The usual case costs one test per step.
        if not self.num_rows or self._is_for_samples:
            env = upstream.env_of(self)
            if env is None:
                self._refuse_samples()
            assert env.output_spec is not None and env.input_spec is not None
            if not self.num_rows:  # appended to the chain of an env that has its specs already
                env.empty_cache()
                assert env.output_spec is not None and env.input_spec is not None
        return self._buffers

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._sized()
        return self._begin(tensordict_reset, self._rows_that_reset(tensordict, tensordict_reset))

    @abstractmethod
    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        """Let the masked rows begin an episode."""

    def _rows_that_reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> Tensor:
        """Return which rows reset, bool [E]; all of them where there is no mask."""
        # Nearly every reset has one mask and nothing else: a look-up spares a walk through the keys.
        if len(tensordict.keys()) == 1 and (only := tensordict.get("_reset", None)) is not None:
            return _per_row(only, self.num_rows)
        # Nested envs have several masks; a row resets where any of them says so.
        masks = [
            _per_row(mask, self.num_rows)
            for key, mask in tensordict.items(True, True)
            if key == "_reset" or key[-1] == "_reset"
        ]
        if not masks:
            return torch.ones(self.num_rows, dtype=torch.bool, device=tensordict_reset.device)
        return functools.reduce(torch.logical_or, masks)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse: without an env there are no steps and no resets to follow."""
        self._refuse_samples()

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # A replay buffer calls the inverse on its samples, which have no episode to keep state of.
        if self._is_for_samples and type(self).forward is RowTransform.forward:
            self._refuse_samples()
        return tensordict

    def _refuse_samples(self) -> NoReturn:
        raise RuntimeError(
            f"{type(self).__name__} has state per env: use it in an env, not on a batch of samples"
        )

    def clone(self) -> Self:
        """Copy, buffers included: TorchRL rebuilds parts of an env from clones and may run them."""
        copy = super().clone()
        # The copy of TorchRL shares the tensors, which change in place.
        copy._buffers = {}
        for name, buffer in self._buffers.items():
            copy._buffers[name] = None if buffer is None else buffer.clone()
        return copy

    def _load_from_state_dict(self, state_dict: State, prefix: str, *args: Any) -> None:
        # Buffers that the env has not sized yet take the size of the loaded ones.
        for name, present in self._buffers.items():
            loaded = state_dict.get(prefix + name)
            if present is None and isinstance(loaded, Tensor):
                self._buffers[name] = torch.empty_like(loaded)
        super()._load_from_state_dict(state_dict, prefix, *args)


def _per_row(mask: Tensor, num_rows: int) -> Tensor:
    flat = mask.reshape(num_rows, -1)
    # Kernels read it by address.
    if flat.shape[1] == 1:
        return flat[:, 0].contiguous()
    return flat.any(-1)


class KeyedTransform(RowTransform):
    """Base of transforms with random draws from a named `stream`; a config names it, else class and keys do.

    Of several transforms in an env with the same class and keys, those behind the first have streams by their number.

    Draws in a step are keyed by `step_count`, which counts env steps; draws at a reset by `reset_count_E`, which counts
    each row's own resets. So a reset of one row never changes another row's numbers, and TorchRL's reset of the rows
    that are done equals a masked reset at every step. `seed` holds until `seed_` or the env's `set_seed` gives another;
    None draws one from torch's generator at the first reset, another in each worker process.
    """

    purposes: ClassVar[tuple[str, ...]] = ()
    """The purposes of the class's draws, each with a separate stream."""

    seed_value: Tensor
    step_count: Tensor
    reset_count_E: Tensor

    def __init__(
        self,
        *keys: Keys | None,
        seed: int | None = None,
        stream: str | None = None,
        **others: Keys | bool | None,
    ) -> None:
        super().__init__(*keys, **others)  # pyright: ignore[reportArgumentType]
        self._register_rows("reset_count_E")
        every = (self.in_keys, self.out_keys, self.in_keys_inv, self.out_keys_inv)
        self._is_named = stream is not None
        if stream is None:
            self.stream = type(self).__name__ + "".join(map(str, every))
        else:
            self.stream = stream
        self._name_streams(self.purposes)
        self._is_seeded = seed is not None
        self.register_buffer("seed_value", torch.tensor(_NO_SEED if seed is None else seed))
        self.register_buffer("step_count", torch.zeros((), dtype=torch.int64))

    def _name_streams(self, purposes: Iterable[str]) -> None:
        """Name the streams of draws: with names, one more transform in a chain changes no draws of the others."""
        self._streams = tuple(purposes)
        self._make_stream_ids(self.stream)

    def _make_stream_ids(self, stream: str) -> None:
        self._stream_ids = {name: random.stream_id(f"{stream}/{name}") for name in self._streams}

    def seed_(self, seed: int) -> Self:
        """Set the seed and start the counters again, in place."""
        self._is_seeded = True
        self.seed_value.fill_(seed)
        self.step_count.zero_()
        # A transform may be seeded before an env has sized its buffers.
        if self._buffers["reset_count_E"] is not None:
            self.reset_count_E.zero_()
        return self

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        upstream.hear_seeds(upstream.env_of(self), seed_transforms)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._take_seed()
        return super()._reset(tensordict, tensordict_reset)

    def _take_seed(self) -> None:
        """Draw a seed where none was given."""
        if not self._is_seeded:
            self.seed_(upstream.fresh_seed())

    def _load_from_state_dict(self, state_dict: State, prefix: str, *args: Any) -> None:
        super()._load_from_state_dict(state_dict, prefix, *args)
        # The one value that no seed has stands for a state that was saved before any draw.
        self._is_seeded = bool(self.seed_value != _NO_SEED)

    def _size_rows(self, specs: Composite) -> None:
        super()._size_rows(specs)
        self._size_buffer("reset_count_E", torch.int64)
        # The chain is whole here, and comes here again when it changes. Who gave a name twice may mean the same draws.
        alike = 0 if self._is_named else _count_alike(self)
        self._make_stream_ids(f"{self.stream}#{alike + 1}" if alike else self.stream)

    def _rows_that_reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> Tensor:
        mask_E = super()._rows_that_reset(tensordict, tensordict_reset)
        self.reset_count_E.add_(mask_E)
        return mask_E

    def _step_keys(self, purpose: str, *, shared: bool = False) -> random.RowKeys:
        stream = self._stream_ids[purpose]
        # A shared draw is one row, which broadcasts over all envs.
        rows = 1 if shared else self.num_rows
        return random.row_keys(self.seed_value, stream, self.step_count, rows, shared=shared)

    def _reset_keys(self, purpose: str) -> random.RowKeys:
        return random.row_keys(
            self.seed_value, self._stream_ids[purpose], self.reset_count_E, self.num_rows
        )


def _count_alike(transform: KeyedTransform) -> int:
    """Count the transforms of an env that stand before this one, inside or in its own chain, with its stream."""
    env = upstream.env_of(transform)
    if not isinstance(env, TransformedEnv):
        return 0
    before: list[KeyedTransform] = []
    for module in env.transform.modules():
        if module is transform:
            break
        if isinstance(module, KeyedTransform):
            before.append(module)
    inside = held_transforms(env.base_env, KeyedTransform)
    return sum(other.stream == transform.stream for other in (*before, *inside))


def held_transforms(env: EnvBase, kind: type[Held]) -> Iterator[Held]:
    """Yield each transform of a kind that an env holds, also in a `TransformedEnv` further inside."""
    inner: Any = env
    while isinstance(inner, TransformedEnv):
        for module in inner.transform.modules():
            if isinstance(module, kind):
                yield module
        inner = inner.base_env


def seed_transforms(env: EnvBase, seed: int) -> None:
    """Seed all transforms of an env that have draws or counters."""
    for transform in held_transforms(env, KeyedTransform):
        transform.seed_(seed)


class Switched(Transform):
    """Mixin of transforms that are for training only: the buffer `enabled` follows the mode of the env."""

    enabled: Tensor

    def _register_switch(self, enabled: bool) -> None:
        # The wish of the user, which `train()` restores after an evaluation.
        self._wanted = enabled
        self.register_buffer("enabled", torch.tensor(enabled), persistent=False)

    def enable_(self, enabled: bool = True) -> Self:
        """Turn it on or off, in place: a captured or compiled step follows."""
        self._wanted = enabled
        self.enabled.fill_(enabled)
        return self

    def train(self, mode: bool = True) -> Self:
        """Follow the mode of the env."""
        super().train(mode)
        # TorchRL calls `eval()` while it attaches a transform, which is no wish to turn it off.
        if upstream.is_in_env(self):
            self.enabled.fill_(self._wanted and mode)
        return self


class FollowsLevel(Transform):
    """Mixin of transforms that a curriculum can drive: the buffer `level`, float32 [], 1 until it is changed."""

    level: Tensor

    def _register_level(self, *, is_used: bool) -> None:
        self.register_buffer("level", torch.ones(()), persistent=is_used)

    def follow_level_(self, level: Shaped[Tensor, "*any"] | float) -> Self:
        """Follow a level: a number is copied; a tensor is read again at every step, wherever it is changed in place.

        Raises ValueError if a tensor is not float32 of shape [], or a number is outside [0, 1].
        """
        if isinstance(level, Tensor):
            if level.shape != () or level.dtype != torch.float32:
                raise ValueError(
                    f"level has shape {tuple(level.shape)} and dtype {level.dtype}: expected () and torch.float32"
                )
            # The tensor itself, so that a curriculum that changes it in place needs no call.
            self._buffers["level"] = level
        else:
            # A number is checked; a tensor's values would have to be read on the host.
            checks.check_in_range("level", level, low=0.0, high=1.0)
            self.level.fill_(level)
        return self


def follow_level(transforms: Iterable[Transform], level: Float32[Tensor, ""] | float) -> None:
    """Let all transforms that can follow the level do so."""
    for transform in transforms:
        for module in transform.modules():
            if isinstance(module, FollowsLevel):
                module.follow_level_(level)


def by_level(
    start: float | Float32[Tensor, "*shape"],
    end: float | Float32[Tensor, "*shape"],
    level: Float32[Tensor, "*level"],
) -> Float32[Tensor, "*found"]:
    """Return a value that is `start` at level 0, `end` at level 1, and linear in between."""
    if isinstance(start, Tensor) and isinstance(end, Tensor):
        return torch.lerp(start, end, level)
    return start + (end - start) * level


def checked_action(
    tensordict: TensorDictBase, key: NestedKey, leaf: Sequence[int], dtype: torch.dtype
) -> Shaped[Tensor, "*leaf"]:
    """Return the action, refused before it reaches a buffer: the env sees only the buffer's output."""
    action = tensordict.get(key)
    expected = (*tensordict.batch_size, *leaf)
    if tuple(action.shape) != expected or action.dtype != dtype:
        raise ValueError(
            f"action {key!r} has shape {tuple(action.shape)} and dtype {action.dtype}: expected {expected} and {dtype}"
        )
    # Buffers change in place: no gradient of the policy may reach them.
    return action.detach()
