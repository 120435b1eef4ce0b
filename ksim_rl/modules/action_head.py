"""This module chooses the last layer that a policy needs for an env's actions."""

import math
from typing import Any

import torch
from jaxtyping import Float
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl import data as specs
from torchrl.data import Composite, TensorSpec

from ksim_rl.modules.heads import (
    ActorCfg,
    CategoricalHead,
    GaussianHead,
    MixedHead,
    TanhGaussianHead,
    TruncatedGaussianHead,
)
from ksim_rl.modules.mlp import Device


def action_range(
    spec: TensorSpec, bound: float, *, device: Device = None
) -> tuple[Float[Tensor, " L"], Float[Tensor, " L"]]:
    """Return the lowest and highest action.

    Off-policy methods need bounded actions: their critics are asked about whatever the policy proposes, and there is no
    trust region that keeps it near what was tried. Where the spec is bounded these are its bounds; elsewhere (joint
    position offsets, say) they are -bound and bound, in the units of the action, before the action term's own scale.
    """
    low, high = (getattr(getattr(spec, "space", None), name, None) for name in ("low", "high"))
    shape = spec.shape[-1:]
    lowest = torch.full(shape, -bound, device=device)
    highest = torch.full(shape, bound, device=device)
    if not isinstance(low, Tensor) or not isinstance(high, Tensor):
        return lowest, highest
    # A spec has the batch dims of its env; all envs have the same bounds. Unbounded ones are huge or infinite.
    low, high = (edge.reshape(-1, *shape)[0].to(lowest) for edge in (low, high))
    bounded = (low > -1e6) & (high < 1e6)
    return torch.where(bounded, low, lowest), torch.where(bounded, high, highest)


DISCRETE = (specs.Categorical, specs.OneHot)
BOUNDED_HEADS: dict[str, type[TanhGaussianHead]] = {
    "tanh_gaussian": TanhGaussianHead,
    "truncated_gaussian": TruncatedGaussianHead,
}


def make_head(
    cfg: ActorCfg, action_spec: TensorSpec, feature_dim: int, *, device: Device = None
) -> tuple[nn.Module, list[NestedKey]]:
    """Build the head for a spec, and return it with the keys of the actions.

    Args:
        cfg: names the distribution of continuous actions.
        action_spec: of one action, under the key "action"; or a `Composite` of one or several, such as the env's
            `full_action_spec`, with its batch dims as shape.

    Raises:
        ValueError: naming the action that does not go with `cfg.distribution`.
    """
    leaves = _leaves(action_spec)
    if cfg.distribution != "categorical" and all(isinstance(leaf, DISCRETE) for leaf, _ in leaves.values()):
        names = " and ".join(f"the action {key!r}" for key in leaves)
        raise ValueError(f"distribution={cfg.distribution!r}, but {names} is discrete: use 'categorical'")
    heads: dict[NestedKey, nn.Module] = {}
    for key, (leaf, shape) in leaves.items():
        make = _choosing if isinstance(leaf, DISCRETE) else _continuous
        heads[key] = make(cfg, key, leaf, tuple(shape), feature_dim=feature_dim, device=device)
    keys = list(heads)
    return (heads[keys[0]] if len(keys) == 1 else MixedHead(heads)), keys


def _leaves(action_spec: TensorSpec) -> dict[NestedKey, tuple[TensorSpec, torch.Size]]:
    """Return each action's spec and shape without batch dims, by key."""
    if isinstance(action_spec, Composite):
        batch_dims = len(action_spec.shape)
        return {key: (leaf, leaf.shape[batch_dims:]) for key, leaf in action_spec.items(True, True)}
    # An index has no dim of its own.
    own_dims = 0 if type(action_spec) is specs.Categorical else 1
    return {"action": (action_spec, action_spec.shape[len(action_spec.shape) - own_dims :])}


def _choosing(
    cfg: ActorCfg, key: NestedKey, leaf: Any, shape: tuple[int, ...], **layer: Any
) -> CategoricalHead:
    one_hot = isinstance(leaf, specs.OneHot)
    if isinstance(leaf, specs.MultiOneHot):
        sizes = tuple(int(size) for size in leaf.nvec)
    elif isinstance(leaf, specs.MultiCategorical):
        sizes = tuple(int(size) for size in leaf.nvec.reshape(-1, shape[-1])[0])
    elif one_hot or not shape:
        sizes = None
    elif len(shape) == 1:
        sizes = (int(leaf.space.n),) * shape[0]
    else:
        raise ValueError(f"action {key!r} has shape {shape}: expected an index or one dim of them")
    num_options = sum(sizes) if sizes is not None else int(leaf.space.n)
    return CategoricalHead(
        cfg, num_options=num_options, sizes=sizes, one_hot=one_hot, dtype=leaf.dtype, **layer
    )


def _continuous(
    cfg: ActorCfg, key: NestedKey, leaf: TensorSpec, shape: tuple[int, ...], **layer: Any
) -> GaussianHead:
    if cfg.distribution == "categorical" or not leaf.dtype.is_floating_point:
        kind = f"{type(leaf).__name__} of {leaf.dtype}".replace("torch.", "")
        raise ValueError(
            f"distribution={cfg.distribution!r} does not go with the action {key!r}, {kind}: "
            "'categorical' is for discrete actions, a kind of gaussian for floating-point ones"
        )
    if len(shape) != 1:
        raise ValueError(f"action {key!r} has shape {shape}: expected one dim")
    if cfg.distribution == "gaussian":
        return GaussianHead(cfg, action_dim=shape[0], **layer)
    low_L, high_L = action_range(leaf, math.inf if cfg.action_bound is None else cfg.action_bound)
    if not bool((low_L.isfinite() & high_L.isfinite()).all()):
        raise ValueError(
            f"distribution={cfg.distribution!r} needs bounds, but the action {key!r} has no finite ones in the env's "
            "spec: set action_bound, e.g. 1.0, or take 'gaussian'"
        )
    return BOUNDED_HEADS[cfg.distribution](cfg, low_L=low_L, high_L=high_L, **layer)
