"""The base of this room's transforms, which checks the keys that they read and write."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from ksim_rl import checks
from ksim_rl.transforms import upstream
from ksim_rl.transforms.specs import drop_leaf, leaf_spec, set_leaf_spec, spell

Keys = Sequence[NestedKey] | NestedKey


class CheckedKeys(Transform):
    """Base of the transforms of this room: they read in keys, and write as many out keys, by default the same ones.

    A key is a name, or a tuple for a nested one. Transforms of actions have `in_keys_inv`, which the env reads, and
    `out_keys_inv`, where the policy writes. An out key that is missing (if `is_paired`) or repeats is refused.
    """

    batch_dims: Sequence[int] = ()
    """Batch dims of the TensorDict in which each in key lies."""
    batch_dims_inv: Sequence[int] = ()
    _is_for_samples = False

    def __init__(
        self,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        in_keys_inv: Keys | None = None,
        out_keys_inv: Keys | None = None,
        *,
        is_paired: bool = True,
    ) -> None:
        keys = as_keys(in_keys or [])
        keys_inv = as_keys(in_keys_inv or [])
        out = checked_out_keys(keys, out_keys, is_paired)
        super().__init__(keys, out, keys_inv, checked_out_keys(keys_inv, out_keys_inv, is_paired))

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        # Replay buffers hold a chain that no env holds, and call its inverse on the data that they store.
        self._is_for_samples = upstream.env_of(self) is None

    def _check_samples(self, tensordict: TensorDictBase, *, is_floating: bool = True) -> None:
        for key in self.in_keys:
            value = tensordict.get(key, None)
            if value is None:
                # A key that is missing is often misspelt: the error names those like it.
                near = checks.near(spell(key), map(spell, tensordict.keys(True, True)))
                raise KeyError(f"{type(self).__name__}: the samples have no {key!r}: {near}")
            if is_floating:
                self._check_floating(key, value.dtype)

    def _check_floating(self, key: NestedKey, dtype: torch.dtype) -> None:
        if not dtype.is_floating_point:
            raise ValueError(
                f"{type(self).__name__}: {key!r} is {dtype}: expected floating-point values"
            )

    def _replace_leaves(
        self,
        specs: Composite,
        new_spec: Callable[[int, TensorSpec], TensorSpec] = lambda _index, spec: spec.clone(),
        *,
        is_inverse: bool = False,
        is_floating: bool = False,
    ) -> list[TensorSpec]:
        """Set the spec of each out key, in place, and return the specs of the in keys as they were.

        `new_spec` takes the index of a key and its spec. The specs of actions (`is_inverse`) move to where the policy
        writes. Raises ValueError where `is_floating` and a spec is of another dtype.
        """
        in_keys = self.in_keys
        out_keys = self.out_keys
        if is_inverse:
            in_keys = self.in_keys_inv
            out_keys = self.out_keys_inv
        # All specs are read before one is written: an out key may be another's in key.
        found = [leaf_spec(specs, key, type(self).__name__) for key in in_keys]
        for key, spec in zip(in_keys, found, strict=True):
            if is_floating:
                self._check_floating(key, spec.dtype)
        # Of the TensorDict around each key: a nested one may have more than the env.
        batch_dims = []
        for key in in_keys:
            if isinstance(key, str):
                around = specs
            else:
                around = specs[key[:-1]]
            batch_dims.append(around.ndim)
        if is_inverse:
            self.batch_dims_inv = batch_dims
        else:
            self.batch_dims = batch_dims
        # The policy's key takes the place of the env's key in the specs of actions.
        replaced = [new_spec(index, spec) for index, spec in enumerate(found)]
        for key, out_key in zip(in_keys, out_keys[: len(in_keys)], strict=True):
            if is_inverse and key != out_key:
                drop_leaf(specs, key)
        # Further out keys are of the subclass, which sets their specs itself.
        for out_key, spec in zip(out_keys[: len(in_keys)], replaced, strict=True):
            set_leaf_spec(specs, out_key, spec)
        return found


def as_keys(keys: Keys) -> list[NestedKey]:
    """Return a list of keys from one key or a list of them; a tuple is one key, and ("a",) is "a"."""
    if isinstance(keys, str | tuple):
        listed: list[NestedKey] = [keys]
    else:
        listed = list(keys)
    short = []
    for key in listed:
        # A key of one part is that part.
        is_one = isinstance(key, tuple) and len(key) == 1
        short.append(key[0] if is_one else key)
    return short


def checked_out_keys(
    in_keys: Sequence[NestedKey], out_keys: Keys | None, is_paired: bool = True
) -> list[NestedKey]:
    """Return out keys, by default the in keys; a ValueError where their number differs (if paired) or one repeats."""
    if out_keys is None:
        out = list(in_keys)
    else:
        out = as_keys(out_keys)
    if is_paired and len(out) != len(in_keys):
        raise ValueError(
            f"out_keys={out} has {len(out)} keys for the {len(in_keys)} of in_keys={in_keys}"
        )
    if len(set(out)) != len(out):
        raise ValueError(f"out_keys={out} repeats a key: each needs its own place")
    return out


def one_per_key(name: str, value: Any, keys: Sequence[NestedKey]) -> list[Any]:
    """Return a value for each key: the same for all, or the entries of a mapping, which has to name all."""
    if not isinstance(value, Mapping):
        return [value] * len(keys)
    if set(value) != set(keys):
        raise ValueError(
            f"{name} has the keys {list(value)}, but in_keys={list(keys)}: give one per key"
        )
    return [value[key] for key in keys]
