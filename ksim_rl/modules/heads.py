"""This module has the last layers of policies: gaussian ones with and without bounds, choices, and several at once."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import CompositeDistribution
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution
from torch.nn import functional

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.modules.categorical import Categorical
from ksim_rl.modules.gaussians import DiagonalGaussian, TanhGaussian, TruncatedGaussian
from ksim_rl.modules.mlp import Device, linear
from ksim_rl.modules.network import OnPolicyNetworkCfg

MIN_STD = 1e-3


@dataclass(frozen=True, kw_only=True)
class ActorCfg(OnPolicyNetworkCfg):
    """The policy network.

    Attributes:
        distribution: of continuous actions: "gaussian", or within bounds "tanh_gaussian" or "truncated_gaussian".
            "categorical" where all actions are discrete; beside continuous ones, discrete ones always are.
        action_bound: the bounded distributions lie in [-action_bound, action_bound] where the env's action spec has no
            bounds; None refuses such a spec.
        init_std: standard deviation of each action at the start, in units of the action; of the bounded distributions
            in units of half the range, before the tanh or the truncation.
        std_type: "scalar" learns the standard deviation itself, "log" its logarithm.
        state_dependent_std: predict the standard deviation from the state instead of learning one per action.
        output_gain: scale of the last layer's weights. Small, so that the first policy acts around zero (the
            default pose of a robot), or the center of the range, in every state.
    """

    distribution: Literal["gaussian", "tanh_gaussian", "truncated_gaussian", "categorical"] = "gaussian"
    action_bound: Positive | None = None
    init_std: Positive = 1.0
    std_type: Literal["scalar", "log"] = "scalar"
    state_dependent_std: bool = False
    output_gain: NonNegative = 0.01

    def __post_init__(self) -> None:
        """Refuse a bound that does nothing."""
        super().__post_init__()
        if self.action_bound is not None and self.distribution not in ("tanh_gaussian", "truncated_gaussian"):
            raise ValueError(
                f"action_bound={self.action_bound!r} does nothing with distribution={self.distribution!r}: "
                "use 'tanh_gaussian' or 'truncated_gaussian', or leave it out"
            )


class GaussianHead(nn.Module):
    """Maps features [..., L] to `loc` and `scale`, each [..., action_dim].

    Args:
        cfg: with `state_dependent_std` its standard deviation is the output of a second layer, which starts at
            `init_std` for every state; of type "scalar" it passes a softplus, so that it stays positive.
        feature_dim: L.
    """

    parameter_names = ("loc", "scale")

    def __init__(self, cfg: ActorCfg, feature_dim: int, action_dim: int, *, device: Device = None) -> None:
        super().__init__()
        self.std_type, init_std = cfg.std_type, cfg.init_std
        self.loc = linear(feature_dim, action_dim, gain=cfg.output_gain, device=device)
        self.std_layer: nn.Linear | None = None
        self.std: nn.Parameter | None = None
        if cfg.state_dependent_std:
            # softplus(x) = init_std at x = log(exp(init_std) - 1).
            offset = math.log(init_std) if cfg.std_type == "log" else math.log(math.expm1(init_std))
            self.std_layer = linear(feature_dim, action_dim, gain=0.0, device=device)
            nn.init.constant_(self.std_layer.bias, offset)
        else:
            start = math.log(init_std) if cfg.std_type == "log" else init_std
            self.std = nn.Parameter(torch.full((action_dim,), start, device=device))

    def forward(
        self, features: Float[Tensor, "*batch L"]
    ) -> tuple[Float[Tensor, "*batch action_dim"], Float[Tensor, "*batch action_dim"]]:
        """Return `(loc, scale)`; `scale` is at least `MIN_STD`."""
        loc = self.loc(features)
        if self.std_layer is None:
            assert self.std is not None
            scale = self.std.exp() if self.std_type == "log" else self.std
        else:
            raw = self.std_layer(features)
            scale = raw.exp() if self.std_type == "log" else functional.softplus(raw)
        # A std that the optimizer pushes to zero or below would give NaN log-probabilities. The gradient
        # passes the bound (a plain clamp stops it), so that a std below it can come back.
        bounded = scale + (scale.clamp_min(MIN_STD) - scale).detach()
        return loc, bounded.expand_as(loc)

    def distribution(self, loc: Float[Tensor, "*batch L"], scale: Float[Tensor, "*batch L"]) -> Distribution:
        """Return the distribution of the action."""
        return DiagonalGaussian(loc, scale)


class TanhGaussianHead(GaussianHead):
    """Maps features [..., L] to `loc` and `scale` of a `TanhGaussian`, before the tanh.

    Args:
        low_L, high_L: bounds of the action.
        cfg, feature_dim: of `GaussianHead`.
    """

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

    def distribution(self, loc: Float[Tensor, "*batch L"], scale: Float[Tensor, "*batch L"]) -> Distribution:
        """Return the distribution of the action."""
        return TanhGaussian(loc, scale, self.low, self.high)


class TruncatedGaussianHead(TanhGaussianHead):
    """Maps features [..., L] to `loc` and `scale` of a `TruncatedGaussian`, in units of the action.

    `loc` stays within the bounds, by a tanh, so that no quantity of the distribution loses precision.
    """

    def forward(
        self, features: Float[Tensor, "*batch L"]
    ) -> tuple[Float[Tensor, "*batch action_dim"], Float[Tensor, "*batch action_dim"]]:
        """Return `(loc, scale)`."""
        loc, scale = super().forward(features)
        center, half_range = (self.high + self.low) / 2, (self.high - self.low) / 2
        return center + half_range * torch.tanh(loc), half_range * scale

    def distribution(self, loc: Float[Tensor, "*batch L"], scale: Float[Tensor, "*batch L"]) -> Distribution:
        """Return the distribution of the action."""
        return TruncatedGaussian(loc, scale, self.low, self.high)


class CategoricalHead(nn.Module):
    """Maps features [..., L] to the `logits` [..., N] of a `Categorical`.

    Args:
        cfg, feature_dim: of `GaussianHead`.
        num_options: N, of all choices together.
        **options: `sizes`, `one_hot` and `dtype` of the `Categorical`.
    """

    parameter_names = ("logits",)

    def __init__(
        self, cfg: ActorCfg, feature_dim: int, num_options: int, *, device: Device = None, **options: Any
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
    """Maps features [..., L] to the parameters of each action's distribution; the actions are independent.

    Args:
        heads: by key of the action in the env's action spec, each with `parameter_names` and `distribution`.
    """

    def __init__(self, heads: Mapping[NestedKey, nn.Module]) -> None:
        super().__init__()
        self.action_keys = list(heads)
        self.heads = nn.ModuleList(heads.values())

    @property
    def parameter_keys(self) -> list[NestedKey]:
        """Where the parameters go: `("params", *action key, name)`."""
        return [
            (PARAMETERS, *_path(key), name)
            for key, head in zip(self.action_keys, self.heads, strict=True)
            for name in head.parameter_names  # type: ignore[union-attr]
        ]

    def forward(self, features: Float[Tensor, "*batch L"]) -> tuple[Float[Tensor, "*batch ?N"], ...]:
        """Return the parameters in the order of `parameter_keys`."""
        return tuple(parameter for head in self.heads for parameter in head(features))

    def distribution(self, params: TensorDictBase) -> CompositeDistribution:
        """Return the distribution of all actions; `params` is what stands under "params"."""
        parts: dict[Any, Any] = {}
        for key, head in zip(self.action_keys, self.heads, strict=True):
            parameters = {name: params.get((*_path(key), name)) for name in head.parameter_names}  # type: ignore[union-attr]
            parts[key] = head.distribution(**parameters)  # type: ignore[operator]
        return CompositeDistribution.from_distributions(params, parts)


def _path(key: NestedKey) -> tuple[Any, ...]:
    return (key,) if isinstance(key, str) else tuple(key)
