"""This module reads and writes leaf specs and their bounds."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Num
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from ksim_rl import checks

Ends = tuple[Num[Tensor, "*leaf"], Num[Tensor, "*leaf"]]
Device = torch.device | str | int | None


def leaf_spec(observation_spec: Composite, key: NestedKey, owner: str) -> TensorSpec:
    """Return the spec of `key`.

    Raises:
        KeyError: if there is none; it lists the near names.
    """
    leaves = {_spell(leaf): leaf for leaf in observation_spec.keys(True, True)}
    if _spell(key) not in leaves:
        raise KeyError(f"{owner}: the env has no {key!r}: {checks.near(_spell(key), leaves)}")
    return observation_spec[key]


def floating_spec(observation_spec: Composite, key: NestedKey, owner: str) -> TensorSpec:
    """Return the spec of `key`, which has to be of floating point.

    Raises:
        KeyError: if there is none; it lists the near names.
        ValueError: if its dtype is another one.
    """
    spec = leaf_spec(observation_spec, key, owner)
    if not spec.dtype.is_floating_point:
        raise ValueError(f"{owner}: {key!r} is {spec.dtype}: expected floating-point values")
    return spec


def set_leaf_spec(observation_spec: Composite, key: NestedKey, spec: TensorSpec) -> None:
    """Set the spec of `key`, with the nested specs above it."""
    path = key if isinstance(key, tuple) else (key,)
    parent = observation_spec
    for name in path[:-1]:
        if name not in parent:
            parent[name] = Composite(shape=parent.shape, device=parent.device)  # pyright: ignore[reportArgumentType]
        parent = parent[name]
    parent[path[-1]] = spec


def drop_leaf_spec(observation_spec: Composite, key: NestedKey) -> None:
    """Remove the spec of `key`, and nested specs that it leaves empty."""
    del observation_spec[key]
    if isinstance(key, tuple) and len(key) > 1:
        above = key[:-1] if len(key) > 2 else key[0]
        if not list(observation_spec[above].keys()):
            drop_leaf_spec(observation_spec, above)


def replace_leaves(
    specs: Composite,
    in_keys: Sequence[NestedKey],
    out_keys: Sequence[NestedKey],
    owner: str,
    new_spec: Callable[[int, TensorSpec], TensorSpec] = lambda _index, spec: spec.clone(),
    *,
    moves: bool = False,
    is_floating: bool = False,
) -> list[TensorSpec]:
    """Set the spec of each out key from that of its in key, and return those of the in keys as they were.

    Args:
        specs: changed in place.
        owner: who asks, for errors.
        new_spec: of the index of the key and its spec.
        moves: whether in keys that are no out keys go.
        is_floating: whether other dtypes are refused.
    """
    found = [(floating_spec if is_floating else leaf_spec)(specs, key, owner) for key in in_keys]
    replaced = [new_spec(index, spec) for index, spec in enumerate(found)]
    for key, out_key in zip(in_keys, out_keys, strict=True):
        if moves and key != out_key:
            drop_leaf_spec(specs, key)
    for out_key, spec in zip(out_keys, replaced, strict=True):
        set_leaf_spec(specs, out_key, spec)
    return found


def bounds(spec: TensorSpec) -> tuple[Num[Tensor, "*leaf"], Num[Tensor, "*leaf"]]:
    """Return (low, high) in the spec's shape; infinite where the spec has none."""
    if isinstance(spec, Bounded):
        space: Any = spec.space
        return space.low.expand(spec.shape).clone(), space.high.expand(spec.shape).clone()
    high = torch.full(spec.shape, torch.inf, device=spec.device)
    return -high, high


def bounded(
    low: Num[Tensor, "*leaf"], high: Num[Tensor, "*leaf"], *, dtype: torch.dtype, device: Device
) -> TensorSpec:
    """Return a `Bounded` spec, or `Unbounded` where no element has a bound."""
    if bool(torch.isinf(low).all()) and bool(torch.isinf(high).all()):
        return Unbounded(shape=low.shape, dtype=dtype, device=device)
    return Bounded(low=low.to(dtype), high=high.to(dtype), shape=low.shape, dtype=dtype, device=device)


def add_bounds(a: Ends, b: Ends) -> Ends:
    """Return the range of x + y for x in a, y in b."""
    return a[0] + b[0], a[1] + b[1]


def multiply_bounds(a: Ends, b: Ends) -> Ends:
    """Return the range of x * y for x in a, y in b; 0 times infinity is 0, as no finite x exceeds it."""
    corners = torch.stack(
        [torch.nan_to_num(x * y, nan=0.0, posinf=torch.inf, neginf=-torch.inf) for x in a for y in b]
    )
    return corners.amin(0), corners.amax(0)


def _spell(key: NestedKey) -> str:
    return key if isinstance(key, str) else "/".join(map(str, key))
