"""The state value function: observation normalization and an MLP."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torchrl.modules import ValueOperator

from ksim_rl.checks import check_in_range
from ksim_rl.modules.mlp import check_network, mlp
from ksim_rl.modules.observation_keys import ObservationKey, checked_keys, side_by_side
from ksim_rl.modules.observation_normalizer import ObservationNormalizer


@dataclass(frozen=True, kw_only=True)
class CriticCfg:
    """The value network.

    Attributes:
        in_keys: the observation groups that it reads, side by side; a list names a nested key.
        hidden_dims: widths of the hidden layers.
        activation: one of `ksim_rl.modules.ACTIVATIONS`.
        obs_normalization: normalize observations by running statistics inside the network.
        output_gain: scale of the last layer's weights.
    """

    in_keys: tuple[ObservationKey, ...] = ("critic",)
    hidden_dims: tuple[int, ...] = (512, 256, 128)
    activation: str = "elu"
    obs_normalization: bool = True
    output_gain: float = 1.0

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        object.__setattr__(self, "in_keys", checked_keys(self.in_keys))
        object.__setattr__(self, "hidden_dims", tuple(self.hidden_dims))
        check_network(self.hidden_dims, self.activation)
        check_in_range("output_gain", self.output_gain, low=0.0)


class ValueNetwork(nn.Module):
    """Maps observations [..., L_i] to a state value [..., 1].

    Attributes:
        normalizer: an `ObservationNormalizer`, or None.
    """

    def __init__(self, cfg: CriticCfg, *, obs_dim: int, device: torch.device | str | None = None) -> None:
        super().__init__()
        self.normalizer = ObservationNormalizer(obs_dim, device=device) if cfg.obs_normalization else None
        self.layers = mlp(
            obs_dim,
            cfg.hidden_dims,
            1,
            activation=cfg.activation,
            output_gain=cfg.output_gain,
            device=device,
        )

    def forward(self, *observations: Tensor) -> Tensor:
        """Return the state value [..., 1] for observations that stand side by side."""
        obs = side_by_side(observations)
        if self.normalizer is not None:
            obs = self.normalizer(obs)
        return self.layers(obs)


def make_critic(cfg: CriticCfg, *, obs_dim: int, device: torch.device | str | None = None) -> ValueOperator:
    """Build the critic as TorchRL's `ValueOperator`.

    Reads `cfg.in_keys`, `obs_dim` numbers side by side, and writes `state_value` [..., 1].
    """
    network = ValueNetwork(cfg, obs_dim=obs_dim, device=device)
    return ValueOperator(network, in_keys=list(cfg.in_keys), out_keys=["state_value"])
