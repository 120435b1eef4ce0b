"""The last layers of policies, which map features to the parameters of an action's distribution."""

import math
from collections.abc import Mapping
from contextlib import nullcontext
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import CompositeDistribution
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution
from torch.nn import functional
from torchrl import data as specs
from torchrl.data import Composite, TensorSpec

from ksim_rl.modules.actor_cfg import ActorCfg
from ksim_rl.modules.categorical import Categorical
from ksim_rl.modules.distributions import (
    DiagonalGaussian,
    TanhGaussian,
    TruncatedGaussian,
    VectorDistribution,
)
from ksim_rl.modules.mlp import Device, linear
from ksim_rl.transforms.specs import path_of


class GaussianHead(nn.Module):
    """Maps features [..., L] to `loc` and `scale`, each [..., action_dim].

    With `cfg.state_dependent_std` the standard deviation is the output of a second layer, which starts at `init_std`
    for every state; of type "scalar" it passes a softplus, so that it stays positive.
    """

    parameter_names = ("loc", "scale")
    kind: type[VectorDistribution] = DiagonalGaussian
    bounds: tuple[Tensor, ...] = ()

    def __init__(
        self, cfg: ActorCfg, feature_dim: int, action_dim: int, *, device: Device = None
    ) -> None:
        super().__init__()
        self.std_type = cfg.std_type
        self.min_std = cfg.min_std
        init_std = cfg.init_std
        self.loc = linear(feature_dim, action_dim, gain=cfg.output_gain, device=device)
        self.std_layer: nn.Linear | None = None
        self.std: nn.Parameter | None = None
        if cfg.state_dependent_std:
            # softplus(x) = init_std at x = log(exp(init_std) - 1).
            if cfg.std_type == "log":
                offset = math.log(init_std)
            else:
                offset = math.log(math.expm1(init_std))
            # Gain zero: the standard deviation begins the same in every state.
            self.std_layer = linear(feature_dim, action_dim, gain=0.0, device=device)
            nn.init.constant_(self.std_layer.bias, offset)
        else:
            if cfg.std_type == "log":
                start = math.log(init_std)
            else:
                start = init_std
            self.std = nn.Parameter(torch.full((action_dim,), start, device=device))

    def forward(
        self, features: Float[Tensor, "*batch L"]
    ) -> tuple[Float[Tensor, "*batch action_dim"], Float[Tensor, "*batch action_dim"]]:
        """Return `loc`, and `scale` of at least `cfg.min_std`; autocast, which would move narrow policies, is off."""
        # The context is entered only under autocast, since it costs time in every call.
        kind = features.device.type
        with (
            torch.autocast(kind, enabled=False)
            if torch.is_autocast_enabled(kind)
            else nullcontext()
        ):
            features = features.to(self.loc.weight.dtype)
            loc = self.loc(features)
            return loc, self.scale(features).expand_as(loc)

    def scale(
        self, features: Float[Tensor, "*batch L"] | None = None
    ) -> Float[Tensor, "*own action_dim"]:
        """Return the `scale`; where it does not depend on the state it is [action_dim], and needs no features."""
        # One standard deviation per action for all states, or a second layer's output for each.
        if self.std_layer is None:
            assert self.std is not None
            if self.std_type == "log":
                scale = self.std.exp()
            else:
                scale = self.std
        else:
            # The softplus keeps the output of a "scalar" layer positive.
            raw = self.std_layer(features)
            if self.std_type == "log":
                scale = raw.exp()
            else:
                scale = functional.softplus(raw)
        # A std that the optimizer pushes to zero or below would give NaN log-probabilities. The gradient
        # passes the bound (a plain clamp stops it), so that a std below it can come back.
        return scale + (scale.clamp_min(self.min_std) - scale).detach()

    def distribution(
        self, loc: Float[Tensor, "*batch L"], scale: Float[Tensor, "*batch L"]
    ) -> Distribution:
        """Return the distribution of the action."""
        return self.kind(loc, scale, *self.bounds)


class TanhGaussianHead(GaussianHead):
    """Maps features [..., L] to `loc` and `scale` of a `TanhGaussian` within [low_L, high_L], before the tanh."""

    kind = TanhGaussian
    low: Tensor
    high: Tensor

    def __init__(
        self,
        cfg: ActorCfg,
        feature_dim: int,
        *,
        low_L: Float[Tensor, " L"],
        high_L: Float[Tensor, " L"],
        device: Device = None,
    ) -> None:
        super().__init__(cfg, feature_dim, len(low_L), device=device)
        # They are the env's, so they are no part of a checkpoint.
        self.register_buffer("low", low_L.to(device, copy=True), persistent=False)
        self.register_buffer("high", high_L.to(device, copy=True), persistent=False)

    @property
    def bounds(self) -> tuple[Float[Tensor, " L"], ...]:  # type: ignore[override]
        """The bounds, wherever the head is moved or copied."""
        return self.low, self.high


class TruncatedGaussianHead(TanhGaussianHead):
    """Maps features [..., L] to `loc` and `scale` of a `TruncatedGaussian`, in units of the action.

    `loc` stays within the bounds, by a tanh, so that no quantity of the distribution loses precision.
    """

    kind = TruncatedGaussian

    def forward(
        self, features: Float[Tensor, "*batch L"]
    ) -> tuple[Float[Tensor, "*batch action_dim"], Float[Tensor, "*batch action_dim"]]:
        """Return `(loc, scale)`."""
        loc, scale = super().forward(features)
        # The unbounded output of the layer becomes a mean inside of the box.
        center = (self.high + self.low) / 2
        half_range = (self.high - self.low) / 2
        return center + half_range * torch.tanh(loc), half_range * scale


class CategoricalHead(nn.Module):
    """Maps features [..., L] to the `logits` [..., num_options] of a `Categorical`, which takes the other options."""

    parameter_names = ("logits",)

    def __init__(
        self,
        cfg: ActorCfg,
        feature_dim: int,
        num_options: int,
        *,
        device: Device = None,
        **options: Any,
    ) -> None:
        super().__init__()
        self.logits = linear(feature_dim, num_options, gain=cfg.output_gain, device=device)
        self.options = options

    def forward(self, features: Float[Tensor, "*batch L"]) -> tuple[Float[Tensor, "*batch N"]]:
        """Return `(logits,)`."""
        return (self.logits(features),)

    def distribution(self, logits: Float[Tensor, "*batch N"]) -> Categorical:
        """Return the distribution of the choices."""
        return Categorical(logits, **self.options)


PARAMETERS = "params"


class MixedHead(nn.Module):
    """Maps features [..., L] to the parameters of the distributions of several independent actions, a head each."""

    def __init__(self, heads: Mapping[NestedKey, nn.Module]) -> None:
        super().__init__()
        self.action_keys = list(heads)
        self.heads = nn.ModuleList(heads.values())

    @property
    def parameter_keys(self) -> list[NestedKey]:
        """Where the parameters go: `("params", *action key, name)`."""
        return [
            (PARAMETERS, *path_of(key), name)
            for key, head in zip(self.action_keys, self.heads, strict=True)
            for name in head.parameter_names  # type: ignore[union-attr]
        ]

    def forward(
        self, features: Float[Tensor, "*batch L"]
    ) -> tuple[Float[Tensor, "*batch ?N"], ...]:
        """Return the parameters in the order of `parameter_keys`."""
        return tuple(parameter for head in self.heads for parameter in head(features))

    def distribution(self, params: TensorDictBase) -> CompositeDistribution:
        """Return the distribution of all actions; `params` is the entry at "params"."""
        # Each head makes its own distribution from its part of the parameters.
        parts: dict[NestedKey, Distribution] = {}
        for key, head in zip(self.action_keys, self.heads, strict=True):
            parameters = {name: params.get((*path_of(key), name)) for name in head.parameter_names}  # type: ignore[union-attr]
            parts[key] = head.distribution(**parameters)  # type: ignore[operator]
        return CompositeDistribution.from_distributions(params, parts)


def action_range(
    spec: TensorSpec, bound: float, *, device: Device = None
) -> tuple[Float[Tensor, " L"], Float[Tensor, " L"]]:
    """Return the lowest and highest action: the bounds of the spec, or -bound and bound where it has none.

    Off-policy methods need bounded actions: their critics are asked about whatever the policy proposes, and there is no
    trust region that keeps it near tried actions. `bound` is in the units of the action, before its term's own scale.
    """
    # Discrete specs have a space without these two, and unbounded ones may have no space.
    space = getattr(spec, "space", None)
    low = getattr(space, "low", None)
    high = getattr(space, "high", None)
    shape = spec.shape[-1:]
    lowest = torch.full(shape, -bound, device=device)
    highest = torch.full(shape, bound, device=device)
    if not isinstance(low, Tensor) or not isinstance(high, Tensor):
        return lowest, highest
    # A spec has the batch dims of its env; all envs have the same bounds. Unbounded ones are huge or infinite.
    low = low.reshape(-1, *shape)[0].to(lowest)
    high = high.reshape(-1, *shape)[0].to(lowest)
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

    The spec is of one action, under the key "action", or a `Composite` of one or several, such as the env's
    `full_action_spec`, with its batch dims as shape. Raises ValueError, naming the action, where it does not go with
    `cfg.distribution`.
    """
    # One head per action; several are joined in a `MixedHead`.
    leaves = _leaves(action_spec)
    # Discrete actions need no setting next to continuous ones, but a gaussian for them only is a mistake.
    if cfg.distribution != "categorical" and all(
        isinstance(leaf, DISCRETE) for leaf, _ in leaves.values()
    ):
        names = " and ".join(f"the action {key!r}" for key in leaves)
        raise ValueError(
            f"distribution={cfg.distribution!r}, but {names} is discrete: use 'categorical'"
        )
    heads: dict[NestedKey, nn.Module] = {}
    for key, (leaf, shape) in leaves.items():
        if isinstance(leaf, DISCRETE):
            make = _choosing
        else:
            make = _continuous
        heads[key] = make(cfg, key, leaf, tuple(shape), feature_dim=feature_dim, device=device)
    keys = list(heads)
    return (heads[keys[0]] if len(keys) == 1 else MixedHead(heads)), keys


def _leaves(action_spec: TensorSpec) -> dict[NestedKey, tuple[TensorSpec, torch.Size]]:
    """Return each action's spec and shape without batch dims, by key."""
    if isinstance(action_spec, Composite):
        batch_dims = len(action_spec.shape)
        return {key: (leaf, leaf.shape[batch_dims:]) for key, leaf in action_spec.items(True, True)}
    # An index adds no dim.
    if type(action_spec) is specs.Categorical:
        own_dims = 0
    else:
        own_dims = 1
    return {"action": (action_spec, action_spec.shape[len(action_spec.shape) - own_dims :])}


def _choosing(
    cfg: ActorCfg, key: NestedKey, leaf: Any, shape: tuple[int, ...], **layer: Any
) -> CategoricalHead:
    one_hot = isinstance(leaf, specs.OneHot)
    # How many options each choice has; None for a single choice.
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
    if sizes is not None:
        num_options = sum(sizes)
    else:
        num_options = int(leaf.space.n)
    return CategoricalHead(
        cfg, num_options=num_options, sizes=sizes, one_hot=one_hot, dtype=leaf.dtype, **layer
    )


def _continuous(
    cfg: ActorCfg, key: NestedKey, leaf: TensorSpec, shape: tuple[int, ...], **layer: Any
) -> GaussianHead:
    # A gaussian needs numbers that it can shift and scale.
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
    # Without `action_bound` a spec without bounds gives infinite ones, which are refused below.
    low_L, high_L = action_range(leaf, math.inf if cfg.action_bound is None else cfg.action_bound)
    # Read on the host, once, as the network is built.
    if not bool((low_L.isfinite() & high_L.isfinite()).all()):
        raise ValueError(
            f"distribution={cfg.distribution!r} needs bounds, but the action {key!r} has no finite ones in the env's "
            "spec: set action_bound, e.g. 1.0, or take 'gaussian'"
        )
    return BOUNDED_HEADS[cfg.distribution](cfg, low_L=low_L, high_L=high_L, **layer)
