"""This module builds the state value function: normalization and an MLP."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torchrl.modules import ValueOperator

from ksim_rl.checks import check_in_range
from ksim_rl.modules.mlp import mlp
from ksim_rl.modules.network import ObservingNetwork, OnPolicyNetworkCfg
from ksim_rl.modules.observation_keys import ObservationKey


@dataclass(frozen=True, kw_only=True)
class CriticCfg(OnPolicyNetworkCfg):
    """The value network.

    Attributes:
        output_gain: scale of the last layer's weights.
    """

    in_keys: tuple[ObservationKey, ...] = ("critic",)
    output_gain: float = 1.0

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        check_in_range("output_gain", self.output_gain, low=0.0)


class ValueNetwork(ObservingNetwork):
    """Maps observations [..., L_i] to a state value [..., 1]."""

    def __init__(self, cfg: CriticCfg, *, obs_dim: int, device: torch.device | str | None = None) -> None:
        super().__init__(cfg, obs_dim=obs_dim, device=device)
        self.layers = mlp(
            obs_dim,
            cfg.hidden_dims,
            1,
            activation=cfg.activation,
            output_gain=cfg.output_gain,
            device=device,
        )

    def forward(self, *observations: Float[Tensor, "*batch ?L"]) -> Float[Tensor, "*batch 1"]:
        """Return the state value for observations that stand side by side."""
        return self.layers(self.observe(*observations))


def make_critic(cfg: CriticCfg, *, obs_dim: int, device: torch.device | str | None = None) -> ValueOperator:
    """Build the critic as TorchRL's `ValueOperator`.

    Reads `cfg.in_keys`, `obs_dim` numbers side by side, and writes `state_value` [..., 1].
    """
    network = ValueNetwork(cfg, obs_dim=obs_dim, device=device)
    return ValueOperator(network, in_keys=list(cfg.in_keys), out_keys=["state_value"])
