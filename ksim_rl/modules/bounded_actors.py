"""Policies whose actions lie in a box: the deterministic one of TD3 and the squashed gaussian of SAC."""

from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor

from ksim_rl.checks import check_in_range
from ksim_rl.modules.action_range import action_range
from ksim_rl.modules.mlp import check_network, mlp
from ksim_rl.modules.observation_normalizer import ObservationNormalizer
from ksim_rl.modules.tanh_gaussian import TanhGaussian


@dataclass(frozen=True, kw_only=True)
class DeterministicActorCfg:
    """The policy of TD3: one action for each observation.

    Attributes:
        hidden_dims: widths of the hidden layers.
        activation: one of `ksim_rl.modules.ACTIVATIONS`.
        layer_norm: normalize before each activation.
        obs_normalization: normalize observations by running statistics inside the network.
        output_gain: scale of the last layer's weights; small, so that the first policy acts around the middle.
        action_bound: actions lie in [-action_bound, action_bound] where the env's action spec has no bounds.
    """

    hidden_dims: tuple[int, ...] = (512, 256, 128)
    activation: str = "relu"
    layer_norm: bool = False
    obs_normalization: bool = True
    output_gain: float = 0.01
    action_bound: float = 1.0

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        object.__setattr__(self, "hidden_dims", tuple(self.hidden_dims))
        check_network(self.hidden_dims, self.activation)
        check_in_range("output_gain", self.output_gain, low=0.0)
        check_in_range("action_bound", self.action_bound, low=0.0, low_open=True)


@dataclass(frozen=True, kw_only=True)
class SquashedActorCfg:
    """The policy of SAC: a gaussian squashed by tanh, whose standard deviation depends on the observation.

    Attributes:
        hidden_dims: widths of the hidden layers.
        activation: one of `ksim_rl.modules.ACTIVATIONS`.
        layer_norm: normalize before each activation.
        obs_normalization: normalize observations by running statistics inside the network.
        output_gain: scale of the last layer's weights.
        log_std_min, log_std_max: bounds of the log of the standard deviation, before squashing.
        action_bound: actions lie in [-action_bound, action_bound] where the env's action spec has no bounds.
    """

    hidden_dims: tuple[int, ...] = (256, 256)
    activation: str = "relu"
    layer_norm: bool = False
    obs_normalization: bool = True
    output_gain: float = 0.01
    log_std_min: float = -5.0
    log_std_max: float = 2.0
    action_bound: float = 1.0

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        object.__setattr__(self, "hidden_dims", tuple(self.hidden_dims))
        check_network(self.hidden_dims, self.activation)
        check_in_range("output_gain", self.output_gain, low=0.0)
        check_in_range("log_std_min", self.log_std_min)
        check_in_range("log_std_max", self.log_std_max)
        if self.log_std_min >= self.log_std_max:
            raise ValueError(
                f"log_std_min={self.log_std_min!r} is not below log_std_max={self.log_std_max!r}"
            )
        check_in_range("action_bound", self.action_bound, low=0.0, low_open=True)


class BoundedActor(nn.Module):
    """Normalization, hidden layers, and a last layer: [..., L] to [..., output_dim].

    Attributes:
        normalizer: an `ObservationNormalizer`, or None.
        low, high: of the actions, [action_dim].
    """

    low: Tensor
    high: Tensor

    def __init__(
        self,
        cfg: DeterministicActorCfg | SquashedActorCfg,
        *,
        obs_dim: int,
        output_dim: int,
        action_spec: TensorSpec,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.cfg = cfg
        self.normalizer = ObservationNormalizer(obs_dim, device=device) if cfg.obs_normalization else None
        low, high = action_range(action_spec, cfg.action_bound, device=device)
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.layers = mlp(
            obs_dim,
            cfg.hidden_dims,
            output_dim,
            activation=cfg.activation,
            layer_norm=cfg.layer_norm,
            output_gain=cfg.output_gain,
            device=device,
        )

    def output(self, obs: Tensor) -> Tensor:
        """Return what the last layer says, float32 [..., output_dim]."""
        if self.normalizer is not None:
            obs = self.normalizer(obs)
        # Half precision would round the squashed action, and its density.
        return self.layers(obs).float()


class DeterministicPolicy(BoundedActor):
    """Maps an observation [..., L] to the action [..., action_dim]."""

    def forward(self, obs: Tensor) -> Tensor:
        """Return the action, in [low, high]."""
        center, half_range = (self.high + self.low) / 2, (self.high - self.low) / 2
        return center + half_range * self.output(obs).tanh()


class SquashedPolicy(BoundedActor):
    """Maps an observation [..., L] to `loc` and `scale` before squashing, each [..., action_dim]."""

    cfg: SquashedActorCfg

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return `(loc, scale)`."""
        loc, raw = self.output(obs).chunk(2, dim=-1)
        # A tanh instead of a clamp: the gradient never vanishes wholly at a bound.
        low, high = self.cfg.log_std_min, self.cfg.log_std_max
        return loc, (low + 0.5 * (high - low) * (raw.tanh() + 1.0)).exp()


def make_deterministic_actor(
    cfg: DeterministicActorCfg,
    *,
    obs_dim: int,
    action_spec: TensorSpec,
    in_key: NestedKey = "actor",
    device: torch.device | str | None = None,
) -> TensorDictModule:
    """Build the policy as a TensorDict module: reads `in_key` [..., obs_dim], writes "action" [..., action_dim].

    Args:
        action_spec: the env's; its bounds, where it has any, are those of the actions.
    """
    policy = DeterministicPolicy(
        cfg, obs_dim=obs_dim, output_dim=action_spec.shape[-1], action_spec=action_spec, device=device
    )
    return TensorDictModule(policy, in_keys=[in_key], out_keys=["action"])


def make_squashed_actor(
    cfg: SquashedActorCfg,
    *,
    obs_dim: int,
    action_spec: TensorSpec,
    in_key: NestedKey = "actor",
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """Build the policy as TorchRL's `ProbabilisticActor`.

    It reads `in_key` [..., obs_dim] and writes `loc`, `scale` (before squashing) and `action` [..., action_dim]. It
    samples unless TorchRL's exploration type says otherwise; `ExplorationType.DETERMINISTIC` gives the median.

    Args:
        action_spec: the env's; its bounds, where it has any, are those of the actions.
    """
    policy = SquashedPolicy(
        cfg, obs_dim=obs_dim, output_dim=2 * action_spec.shape[-1], action_spec=action_spec, device=device
    )
    return ProbabilisticActor(
        TensorDictModule(policy, in_keys=[in_key], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        distribution_class=TanhGaussian,
        distribution_kwargs={"low": policy.low, "high": policy.high},
        default_interaction_type=ExplorationType.RANDOM,
    )
