"""Layers that actor and critic share."""

from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from ksim_rl.modules.mlp import check_network, trunk
from ksim_rl.modules.observation_keys import ObservationKey, checked_keys, side_by_side
from ksim_rl.modules.observation_normalizer import ObservationNormalizer

FEATURES = "features"


@dataclass(frozen=True, kw_only=True)
class SharedTrunkCfg:
    """Layers below actor and critic, which read what they write: the key "features".

    Attributes:
        in_keys: the observation groups that it reads, side by side; a list names a nested key.
        hidden_dims: widths of the layers.
        activation: one of `ksim_rl.modules.ACTIVATIONS`.
        obs_normalization: normalize observations by running statistics inside the network.
    """

    in_keys: tuple[ObservationKey, ...] = ("actor",)
    hidden_dims: tuple[int, ...] = (512, 256)
    activation: str = "elu"
    obs_normalization: bool = True

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        object.__setattr__(self, "in_keys", checked_keys(self.in_keys))
        object.__setattr__(self, "hidden_dims", tuple(self.hidden_dims))
        check_network(self.hidden_dims, self.activation)
        if not self.hidden_dims:
            raise ValueError("hidden_dims=(): expected at least one width")


class TrunkNetwork(nn.Module):
    """Maps observations [..., L_i] to features [..., L], L the last width.

    Attributes:
        normalizer: an `ObservationNormalizer`, or None.
    """

    def __init__(
        self, cfg: SharedTrunkCfg, *, obs_dim: int, device: torch.device | str | None = None
    ) -> None:
        super().__init__()
        self.normalizer = ObservationNormalizer(obs_dim, device=device) if cfg.obs_normalization else None
        self.layers = trunk(obs_dim, cfg.hidden_dims, activation=cfg.activation, device=device)

    def forward(self, *observations: Tensor) -> Tensor:
        """Return the features for observations that stand side by side."""
        obs = side_by_side(observations)
        if self.normalizer is not None:
            obs = self.normalizer(obs)
        return self.layers(obs)


def make_shared_trunk(
    cfg: SharedTrunkCfg, *, obs_dim: int, device: torch.device | str | None = None
) -> TensorDictModule:
    """Build the layers as a TensorDict module, the common part of TorchRL's `ActorValueOperator`.

    Reads `cfg.in_keys`, `obs_dim` numbers side by side, and writes "features" [..., L].
    """
    network = TrunkNetwork(cfg, obs_dim=obs_dim, device=device)
    return TensorDictModule(network, in_keys=list(cfg.in_keys), out_keys=[FEATURES])
