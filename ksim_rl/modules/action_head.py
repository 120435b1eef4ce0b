"""This module chooses the last layer that a policy needs for an env's actions."""

import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl import data as specs
from torchrl.data import Composite, TensorSpec

from ksim_rl.modules.action_range import action_range
from ksim_rl.modules.actor_cfg import ActorCfg
from ksim_rl.modules.categorical_head import CategoricalHead
from ksim_rl.modules.gaussian_head import GaussianHead, TanhGaussianHead, TruncatedGaussianHead
from ksim_rl.modules.mixed_head import MixedHead

DISCRETE = (specs.Categorical, specs.OneHot)
BOUNDED_HEADS: dict[str, type[TanhGaussianHead]] = {
    "tanh_gaussian": TanhGaussianHead,
    "truncated_gaussian": TruncatedGaussianHead,
}


def make_head(
    cfg: ActorCfg, action_spec: TensorSpec, feature_dim: int, *, device: torch.device | str | None = None
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
        raise ValueError(
            f"distribution={cfg.distribution!r}, but {_describe(leaves)} is discrete: use 'categorical'"
        )
    heads: dict[NestedKey, nn.Module] = {}
    for key, (leaf, batch_dims) in leaves.items():
        make: Callable[..., nn.Module] = _choosing if isinstance(leaf, DISCRETE) else _continuous
        heads[key] = make(cfg, key, leaf, batch_dims, feature_dim, device)
    keys = list(heads)
    return (heads[keys[0]] if len(keys) == 1 else MixedHead(heads)), keys


def _leaves(action_spec: TensorSpec) -> dict[NestedKey, tuple[TensorSpec, int]]:
    """Return each action's spec and how many of its dims are batch dims, by key."""
    if isinstance(action_spec, Composite):
        batch_dims = len(action_spec.shape)
        return {key: (leaf, batch_dims) for key, leaf in action_spec.items(True, True)}
    # An index has no dim of its own.
    own_dims = 0 if type(action_spec) is specs.Categorical else 1
    return {"action": (action_spec, len(action_spec.shape) - own_dims)}


def _choosing(
    cfg: ActorCfg,
    key: NestedKey,
    leaf: Any,
    batch_dims: int,
    feature_dim: int,
    device: torch.device | str | None,
) -> nn.Module:
    own_shape = leaf.shape[batch_dims:]
    one_hot = isinstance(leaf, specs.OneHot)
    if isinstance(leaf, specs.MultiOneHot):
        sizes = tuple(int(size) for size in leaf.nvec)
    elif isinstance(leaf, specs.MultiCategorical):
        sizes = tuple(int(size) for size in leaf.nvec.reshape(-1, own_shape[-1])[0])
    elif one_hot or not own_shape:
        sizes = None
    elif len(own_shape) == 1:
        sizes = (int(leaf.space.n),) * own_shape[0]
    else:
        raise ValueError(f"action {key!r} has shape {tuple(own_shape)}: expected an index or one dim of them")
    return CategoricalHead(
        feature_dim,
        sum(sizes) if sizes is not None else int(leaf.space.n),
        sizes=sizes,
        one_hot=one_hot,
        dtype=leaf.dtype,
        output_gain=cfg.output_gain,
        device=device,
    )


def _continuous(
    cfg: ActorCfg,
    key: NestedKey,
    leaf: TensorSpec,
    batch_dims: int,
    feature_dim: int,
    device: torch.device | str | None,
) -> nn.Module:
    if cfg.distribution == "categorical" or not leaf.dtype.is_floating_point:
        kind = f"{type(leaf).__name__} of {leaf.dtype}".replace("torch.", "")
        raise ValueError(
            f"distribution={cfg.distribution!r} does not go with the action {key!r}, {kind}: "
            "'categorical' is for discrete actions, a kind of gaussian for floating-point ones"
        )
    if len(leaf.shape) != batch_dims + 1:
        raise ValueError(f"action {key!r} has shape {tuple(leaf.shape[batch_dims:])}: expected one dim")
    options: dict[str, Any] = {
        "init_std": cfg.init_std,
        "std_type": cfg.std_type,
        "state_dependent_std": cfg.state_dependent_std,
        "output_gain": cfg.output_gain,
        "device": device,
    }
    if cfg.distribution == "gaussian":
        return GaussianHead(feature_dim, leaf.shape[-1], **options)
    low_L, high_L = _range(cfg, key, leaf)
    return BOUNDED_HEADS[cfg.distribution](feature_dim, low_L=low_L, high_L=high_L, **options)


def _range(cfg: ActorCfg, key: NestedKey, leaf: TensorSpec) -> tuple[Tensor, Tensor]:
    """Return the bounds of an action [L]."""
    low_L, high_L = action_range(leaf, math.inf if cfg.action_bound is None else cfg.action_bound)
    if not bool((low_L.isfinite() & high_L.isfinite()).all()):
        raise ValueError(
            f"distribution={cfg.distribution!r} needs bounds, but the action {key!r} has no finite ones in the env's "
            "spec: set action_bound, e.g. 1.0, or take 'gaussian'"
        )
    return low_L, high_L


def _describe(leaves: dict[NestedKey, Any]) -> str:
    return " and ".join(f"the action {key!r}" for key in leaves)
