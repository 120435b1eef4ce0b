"""This module holds the bases of transforms with state per env: buffers, draws of their own, a level to follow."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, NoReturn, Self

import torch
from jaxtyping import Float32, Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs.transforms import Transform

from ksim_rl.device import random
from ksim_rl.transforms.specs import Device

Keys = Sequence[NestedKey] | NestedKey


class RowTransform(Transform):
    """Base of transforms with state per env row.

    All state lives in buffers that are changed in place. Those sized by the env are made when the env first asks for
    its specs or resets, never later, so a captured step keeps its addresses. Subclasses make them as they transform the
    specs, by `_size_rows` and `_size_buffer`, and begin episodes in `_begin`.

    Args:
        in_keys, out_keys, in_keys_inv, out_keys_inv: as in `torchrl.envs.transforms.Transform`.
        row_buffers: names of the buffers that the env sizes.
    """

    def __init__(
        self,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        in_keys_inv: Keys | None = None,
        out_keys_inv: Keys | None = None,
        *,
        row_buffers: Sequence[str] = (),
    ) -> None:
        super().__init__(in_keys, out_keys, in_keys_inv, out_keys_inv)  # pyright: ignore[reportArgumentType]
        self.num_rows = 0
        self._row_device: Device = None
        for name in row_buffers:
            self.register_buffer(name, None)

    def _size_rows(self, specs: Composite) -> None:
        """Take note of the number of rows; bases make their buffers here."""
        self.num_rows, self._row_device = specs.shape.numel(), specs.device

    def _size_buffer(self, name: str, dtype: torch.dtype, leaf: Sequence[int] = ()) -> None:
        """Make a zero buffer [E, *leaf], unless there is one of that shape and dtype already."""
        present, shape = self._buffers[name], (self.num_rows, *leaf)
        if present is None or present.shape != shape or present.dtype != dtype:
            self._buffers[name] = torch.zeros(shape, dtype=dtype, device=self._row_device)

    def _size_leaves(
        self, name: str, specs: Composite, leaves: Sequence[TensorSpec], dtype: torch.dtype | None = None
    ) -> None:
        """Make a buffer `<name>_<index>` per leaf, in its dtype or another."""
        for index, spec in enumerate(leaves):
            self._size_buffer(f"{name}_{index}", dtype or spec.dtype, spec.shape[specs.ndim :])

    def _sized(self) -> dict[str, Any]:
        """Return the buffers by name, which answer faster than the module; the specs make those that are missing.

        TorchRL may reset or resume an env before it asks for them.
        """
        if not self.num_rows:
            env = self.container
            if env is None:
                self._refuse_samples()
            assert env.output_spec is not None and env.input_spec is not None
            if not self.num_rows:  # appended to the chain of an env that has its specs already
                env.empty_cache()
                assert env.output_spec is not None and env.input_spec is not None
        return self._buffers

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._sized()
        return self._begin(tensordict_reset, self._rows_that_reset(tensordict, tensordict_reset))

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        """Let the masked rows begin an episode."""
        raise NotImplementedError

    def _rows_that_reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> Tensor:
        """Return which rows reset, bool [E]; all of them where there is no mask."""
        if len(tensordict.keys()) == 1 and (only := tensordict.get("_reset", None)) is not None:
            return _per_row(only, self.num_rows)
        masks = [
            _per_row(mask, self.num_rows)
            for key, mask in tensordict.items(True, True)
            if key == "_reset" or key[-1] == "_reset"
        ]
        if not masks:
            return torch.ones(self.num_rows, dtype=torch.bool, device=tensordict_reset.device)
        mask_E = masks[0]
        for mask in masks[1:]:
            mask_E = mask_E | mask
        return mask_E

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse: without an env there are no steps and no resets to follow."""
        self._refuse_samples()

    def _refuse_samples(self) -> NoReturn:
        raise RuntimeError(
            f"{type(self).__name__} has state per env: use it in an env, not on a batch of samples"
        )

    def clone(self) -> Self:
        """Copy with buffers of its own: TorchRL rebuilds parts of an env from clones and may run them."""
        copy = super().clone()
        copy._buffers = {name: None if b is None else b.clone() for name, b in self._buffers.items()}
        return copy

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        # Buffers that the env has not sized yet take the size of the loaded ones.
        for name, present in self._buffers.items():
            loaded = state_dict.get(prefix + name)
            if present is None and loaded is not None:
                self._buffers[name] = torch.empty_like(loaded)
        super()._load_from_state_dict(state_dict, prefix, *args)


def _per_row(mask: Tensor, num_rows: int) -> Tensor:
    flat = mask.reshape(num_rows, -1)
    # Kernels read it by address.
    return flat[:, 0].contiguous() if flat.shape[1] == 1 else flat.any(-1)


class KeyedTransform(RowTransform):
    """Base of transforms with draws of their own.

    Draws in a step are keyed by `step_count`, which counts env steps; draws at a reset by `reset_count_E`, which counts
    each row's own resets. So a reset of one row never changes another row's numbers, and TorchRL's reset of the rows
    that are done equals a masked reset at every step.

    Args:
        in_keys, out_keys, in_keys_inv, out_keys_inv: as in `torchrl.envs.transforms.Transform`.
        row_buffers: names of the buffers that the env sizes.
        seed: until `seed_` or the env's `set_seed` gives another one.
        stream: name of the stream of draws. Default: the name that a config gives the transform, else its class and
            keys.
    """

    purposes: ClassVar[tuple[str, ...]] = ()
    """What the class draws, each from a stream of its own."""

    seed_value: Tensor
    step_count: Tensor
    reset_count_E: Tensor

    def __init__(
        self,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        in_keys_inv: Keys | None = None,
        out_keys_inv: Keys | None = None,
        *,
        row_buffers: Sequence[str] = (),
        seed: int = 0,
        stream: str | None = None,
    ) -> None:
        names = ("reset_count_E", *row_buffers)
        super().__init__(in_keys, out_keys, in_keys_inv, out_keys_inv, row_buffers=names)
        keys = (self.in_keys, self.out_keys, self.in_keys_inv, self.out_keys_inv)
        self.stream = type(self).__name__ + "".join(map(str, keys)) if stream is None else stream
        self._stream_ids = {
            purpose: random.stream_id(f"{self.stream}/{purpose}") for purpose in self.purposes
        }
        self.register_buffer("seed_value", torch.tensor(seed, dtype=torch.int64))
        self.register_buffer("step_count", torch.zeros((), dtype=torch.int64))

    def seed_(self, seed: int) -> Self:
        """Set the seed and start the counters anew, in place."""
        self.seed_value.fill_(seed)
        self.step_count.zero_()
        if self._buffers["reset_count_E"] is not None:
            self.reset_count_E.zero_()
        return self

    def _size_rows(self, specs: Composite) -> None:
        super()._size_rows(specs)
        self._size_buffer("reset_count_E", torch.int64)

    def _rows_that_reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> Tensor:
        mask_E = super()._rows_that_reset(tensordict, tensordict_reset)
        self.reset_count_E.add_(mask_E)
        return mask_E

    def _step_keys(self, purpose: str, num_rows: int | None = None) -> random.RowKeys:
        rows = self.num_rows if num_rows is None else num_rows
        return random.row_keys(self.seed_value, self._stream_ids[purpose], self.step_count, rows)

    def _reset_keys(self, purpose: str) -> random.RowKeys:
        return random.row_keys(self.seed_value, self._stream_ids[purpose], self.reset_count_E, self.num_rows)


class FollowsLevel(Transform):
    """Mixin of transforms that a curriculum can drive: the buffer `level`, float32 [], 1 until somebody changes it."""

    level: Tensor

    def _register_level(self, *, is_used: bool) -> None:
        self.register_buffer("level", torch.ones(()), persistent=is_used)

    def follow_level_(self, level: Shaped[Tensor, "*any"] | float) -> Self:
        """Follow a level: a number is copied; a tensor is read anew at every step, wherever it is changed in place.

        Raises:
            ValueError: if a tensor is not float32 of shape [], or a number is outside [0, 1].
        """
        if isinstance(level, Tensor):
            if level.shape != () or level.dtype != torch.float32:
                raise ValueError(
                    f"level has shape {tuple(level.shape)} and dtype {level.dtype}: expected () and torch.float32"
                )
            self._buffers["level"] = level
        elif 0.0 <= level <= 1.0:
            self.level.fill_(level)
        else:
            raise ValueError(f"level={level!r}: expected a number in [0, 1]")
        return self


def follow_level(transforms: Iterable[Transform], level: Float32[Tensor, ""] | float) -> None:
    """Let all transforms that can follow the level do so."""
    for transform in transforms:
        for module in transform.modules():
            if isinstance(module, FollowsLevel):
                module.follow_level_(level)


def as_keys(keys: Keys) -> list[NestedKey]:
    """Return a list of keys from one key or a list of them; a tuple is one key, and ("a",) is "a"."""
    listed: list[NestedKey] = [keys] if isinstance(keys, str | tuple) else list(keys)
    return [key[0] if isinstance(key, tuple) and len(key) == 1 else key for key in listed]


def checked_out_keys(in_keys: list[NestedKey], out_keys: Keys | None) -> list[NestedKey]:
    """Return the out keys, by default the in keys.

    Raises:
        ValueError: if their numbers differ, or an out key repeats.
    """
    out = list(in_keys) if out_keys is None else as_keys(out_keys)
    if len(out) != len(in_keys):
        raise ValueError(f"out_keys={out} has {len(out)} keys for the {len(in_keys)} of in_keys={in_keys}")
    if len(set(out)) != len(out):
        raise ValueError(f"out_keys={out} repeats a key: each needs its own place")
    return out


def one_per_key(name: str, value: Any, keys: Sequence[NestedKey]) -> list[Any]:
    """Return what a value is for each key: the same for all, or the entries of a mapping.

    Raises:
        ValueError: if a mapping has other keys.
    """
    if not isinstance(value, Mapping):
        return [value] * len(keys)
    if set(value) != set(keys):
        raise ValueError(f"{name} has the keys {list(value)}, but in_keys={list(keys)}: give one per key")
    return [value[key] for key in keys]


def checked_action(
    tensordict: TensorDictBase, key: NestedKey, leaf: Sequence[int], dtype: torch.dtype
) -> Shaped[Tensor, "*leaf"]:
    """Return the action, refused before it reaches a buffer: the env sees only what comes out of that.

    Raises:
        ValueError: with both shapes and dtypes.
    """
    action = tensordict.get(key)
    expected = (*tensordict.batch_size, *leaf)
    if tuple(action.shape) != expected or action.dtype != dtype:
        raise ValueError(
            f"action {key!r} has shape {tuple(action.shape)} and dtype {action.dtype}: expected {expected} and {dtype}"
        )
    return action
