"""The stochastic policy: observation normalization, an MLP and a diagonal gaussian."""

from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor

from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.modules.diagonal_gaussian import DiagonalGaussian
from ksim_rl.modules.gaussian_head import GaussianHead
from ksim_rl.modules.mlp import check_network, trunk
from ksim_rl.modules.observation_normalizer import ObservationNormalizer

STD_TYPES = ("scalar", "log")


@dataclass(frozen=True, kw_only=True)
class ActorCfg:
    """The policy network.

    Attributes:
        hidden_dims: widths of the hidden layers.
        activation: one of `ksim_rl.modules.ACTIVATIONS`.
        obs_normalization: normalize observations by running statistics inside the network.
        init_std: standard deviation of each action at the start, in units of the action.
        std_type: "scalar" learns the standard deviation itself, "log" its logarithm.
        state_dependent_std: predict the standard deviation from the state instead of learning one per action.
        output_gain: scale of the last layer's weights. Small, so that the first policy acts around zero (the
            default pose of a robot) in every state.
    """

    hidden_dims: tuple[int, ...] = (512, 256, 128)
    activation: str = "elu"
    obs_normalization: bool = True
    init_std: float = 1.0
    std_type: str = "scalar"
    state_dependent_std: bool = False
    output_gain: float = 0.01

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        object.__setattr__(self, "hidden_dims", tuple(self.hidden_dims))
        check_network(self.hidden_dims, self.activation)
        check_in_range("init_std", self.init_std, low=0.0, low_open=True)
        check_choice("std_type", self.std_type, STD_TYPES)
        check_in_range("output_gain", self.output_gain, low=0.0)


class GaussianPolicy(nn.Module):
    """Maps an observation [..., L] to `loc` and `scale` of the action, each [..., action_dim].

    Attributes:
        normalizer: an `ObservationNormalizer`, or None.
    """

    def __init__(
        self, cfg: ActorCfg, *, obs_dim: int, action_dim: int, device: torch.device | str | None = None
    ) -> None:
        super().__init__()
        self.normalizer = ObservationNormalizer(obs_dim, device=device) if cfg.obs_normalization else None
        self.trunk = trunk(obs_dim, cfg.hidden_dims, activation=cfg.activation, device=device)
        self.head = GaussianHead(
            cfg.hidden_dims[-1] if cfg.hidden_dims else obs_dim,
            action_dim,
            init_std=cfg.init_std,
            std_type=cfg.std_type,
            state_dependent_std=cfg.state_dependent_std,
            output_gain=cfg.output_gain,
            device=device,
        )

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Return `(loc, scale)` for `obs` [..., L]."""
        if self.normalizer is not None:
            obs = self.normalizer(obs)
        return self.head(self.trunk(obs))


def make_actor(
    cfg: ActorCfg,
    *,
    obs_dim: int,
    action_dim: int,
    in_key: NestedKey = "actor",
    action_spec: TensorSpec | None = None,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """Build the policy as TorchRL's `ProbabilisticActor`.

    It reads `in_key` [..., obs_dim] and writes `loc`, `scale`, `action` [..., action_dim] and
    `action_log_prob` [...]. It samples unless TorchRL's exploration type says otherwise;
    `ExplorationType.DETERMINISTIC` gives the mean.

    Args:
        action_spec: the env's action spec; kept for its shape and device, the policy does not clip to its
            bounds.
    """
    policy = GaussianPolicy(cfg, obs_dim=obs_dim, action_dim=action_dim, device=device)
    return ProbabilisticActor(
        TensorDictModule(policy, in_keys=[in_key], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        spec=action_spec,
        distribution_class=DiagonalGaussian,
        return_log_prob=True,
        log_prob_key="action_log_prob",
        default_interaction_type=ExplorationType.RANDOM,
    )
