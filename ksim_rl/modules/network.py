"""This module has what the networks share: fields of their configs, and the normalization of what they observe."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ksim_rl.checks import check_in_range
from ksim_rl.modules.mlp import check_network
from ksim_rl.modules.observation_keys import ObservationKey, checked_keys, side_by_side
from ksim_rl.modules.observation_normalizer import ObservationNormalizer


@dataclass(frozen=True, kw_only=True)
class NetworkCfg:
    """The fields that the configs of all networks have.

    Attributes:
        hidden_dims: widths of the hidden layers.
        activation: one of `ksim_rl.modules.ACTIVATIONS`.
        obs_normalization: normalize observations by running statistics inside the network.
    """

    hidden_dims: tuple[int, ...] = (512, 256, 128)
    activation: str = "elu"
    obs_normalization: bool = True

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        object.__setattr__(self, "hidden_dims", tuple(self.hidden_dims))
        check_network(self.hidden_dims, self.activation)


@dataclass(frozen=True, kw_only=True)
class OnPolicyNetworkCfg(NetworkCfg):
    """The fields of networks that choose what they read.

    Attributes:
        in_keys: the observation groups that it reads, side by side; a list names a nested key.
    """

    in_keys: tuple[ObservationKey, ...] = ("actor",)

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        object.__setattr__(self, "in_keys", checked_keys(self.in_keys))


@dataclass(frozen=True, kw_only=True)
class OffPolicyNetworkCfg(NetworkCfg):
    """The fields of the networks of off-policy methods.

    Attributes:
        layer_norm: normalize before each activation.
        output_gain: scale of the last layer's weights; a small one lets the first policy act around the middle.
    """

    hidden_dims: tuple[int, ...] = (256, 256)
    activation: str = "relu"
    layer_norm: bool = False
    output_gain: float = 1.0

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        check_in_range("output_gain", self.output_gain, low=0.0)


class ObservingNetwork(nn.Module):
    """The base of networks that normalize what they read.

    Attributes:
        normalizer: an `ObservationNormalizer`, or None.
    """

    def __init__(self, cfg: NetworkCfg, *, obs_dim: int, device: torch.device | str | None = None) -> None:
        super().__init__()
        self.normalizer = ObservationNormalizer(obs_dim, device=device) if cfg.obs_normalization else None

    def observe(self, *observations: Float[Tensor, "*batch ?L"]) -> Float[Tensor, "*batch L"]:
        """Return what the first layer reads: observations side by side, normalized."""
        obs = side_by_side(observations)
        return obs if self.normalizer is None else self.normalizer(obs)
