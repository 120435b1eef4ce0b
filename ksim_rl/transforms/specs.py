"""Reads and writes leaf specs and their bounds."""

from typing import Any

import torch
from jaxtyping import Num
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from ksim_rl import checks

Ends = tuple[Num[Tensor, "*leaf"], Num[Tensor, "*leaf"]]
Device = torch.device | str | int | None


def spell(key: NestedKey) -> str:
    """Return a key as one string."""
    if isinstance(key, str):
        return key
    return "/".join(map(str, key))


def path_of(key: NestedKey) -> tuple[Any, ...]:
    """Return the names that lead to a leaf."""
    if isinstance(key, str):
        return (key,)
    return tuple(key)


def leaf_spec(observation_spec: Composite, key: NestedKey, owner: str) -> TensorSpec:
    """Return the spec of `key`; the KeyError of a missing one lists the near names."""
    # As text, in which the error can look for near names.
    leaves = {spell(leaf): leaf for leaf in observation_spec.keys(True, True)}
    if spell(key) not in leaves:
        raise KeyError(f"{owner}: the env has no {key!r}: {checks.near(spell(key), leaves)}")
    return observation_spec[key]


def check_no_picture(key: NestedKey, spec: TensorSpec, batch_dims: int, advice: str) -> None:
    """Refuse to flatten a picture: bytes of two dims or more are one, whose pixels are no numbers of a vector."""
    leaf = list(spec.shape[batch_dims:])
    if spec.dtype == torch.uint8 and len(leaf) > 1:
        raise ValueError(f"{key!r} is a picture, uint8 {leaf}, and would be flattened: {advice}")


def set_leaf_spec(observation_spec: Composite, key: NestedKey, spec: TensorSpec) -> None:
    """Set the spec of `key`, with the nested specs above it, if its shape begins with the batch size of these."""
    path = path_of(key)
    parent = observation_spec
    for name in path[:-1]:
        # Nested keys may be new: the nodes above them are made as they are needed.
        if name not in parent:
            parent[name] = Composite(shape=parent.shape, device=parent.device)  # pyright: ignore[reportArgumentType]
        parent = parent[name]
    if spec.shape[: parent.ndim] != parent.shape:
        raise ValueError(
            f"{key!r} lies in a TensorDict of batch size {tuple(parent.shape)}, with which its shape "
            f"{tuple(spec.shape)} does not begin: give another out key"
        )
    parent[path[-1]] = spec


def drop_leaf(tree: Composite | TensorDictBase, key: NestedKey) -> None:
    """Remove a leaf, and the nested nodes that it leaves empty."""
    del tree[key]
    if isinstance(key, tuple) and len(key) > 1:
        above = key[:-1] if len(key) > 2 else key[0]
        # An empty node would be seen as an observation without leaves.
        if not list(tree[above].keys(True, True)):  # pyright: ignore[reportAttributeAccessIssue]
            drop_leaf(tree, above)


def bounds(spec: TensorSpec) -> tuple[Num[Tensor, "*leaf"], Num[Tensor, "*leaf"]]:
    """Return (low, high) in the spec's shape; infinite where the spec has none."""
    # Copies, since specs share the memory of their bounds.
    if isinstance(spec, Bounded):
        space: Any = spec.space
        return space.low.expand(spec.shape).clone(), space.high.expand(spec.shape).clone()
    high = torch.full(spec.shape, torch.inf, device=spec.device)
    return -high, high


def bounded(
    low: Num[Tensor, "*leaf"], high: Num[Tensor, "*leaf"], *, dtype: torch.dtype, device: Device
) -> TensorSpec:
    """Return a `Bounded` spec, or `Unbounded` where no element has a bound."""
    # Specs are made before the first step, where reading the device does no harm.
    if bool(torch.isinf(low).all()) and bool(torch.isinf(high).all()):
        return Unbounded(shape=low.shape, dtype=dtype, device=device)
    return Bounded(
        low=low.to(dtype), high=high.to(dtype), shape=low.shape, dtype=dtype, device=device
    )


def multiply_bounds(a: Ends, b: Ends) -> Ends:
    """Return the range of x * y for x in a, y in b; 0 times infinity is 0, as no finite x exceeds it."""
    # The extremes of a product over two intervals lie at their ends.
    corners = torch.stack(
        [
            torch.nan_to_num(x * y, nan=0.0, posinf=torch.inf, neginf=-torch.inf)
            for x in a
            for y in b
        ]
    )
    return corners.amin(0), corners.amax(0)
