"""This module builds layers that actor and critic share."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from tensordict.nn import TensorDictModule
from torch import Tensor

from ksim_rl.modules.mlp import trunk
from ksim_rl.modules.network import ObservingNetwork, OnPolicyNetworkCfg

FEATURES = "features"


@dataclass(frozen=True, kw_only=True)
class SharedTrunkCfg(OnPolicyNetworkCfg):
    """Layers below actor and critic, which read what they write: the key "features"."""

    hidden_dims: tuple[int, ...] = (512, 256)

    def __post_init__(self) -> None:
        """Refuse values out of range, naming the field."""
        super().__post_init__()
        if not self.hidden_dims:
            raise ValueError("hidden_dims=(): expected at least one width")


class TrunkNetwork(ObservingNetwork):
    """Maps observations [..., L_i] to features [..., L], L the last width."""

    def __init__(
        self, cfg: SharedTrunkCfg, *, obs_dim: int, device: torch.device | str | None = None
    ) -> None:
        super().__init__(cfg, obs_dim=obs_dim, device=device)
        self.layers = trunk(obs_dim, cfg.hidden_dims, activation=cfg.activation, device=device)

    def forward(self, *observations: Float[Tensor, "*batch ?L"]) -> Float[Tensor, "*batch L"]:
        """Return the features for observations that stand side by side."""
        return self.layers(self.observe(*observations))


def make_shared_trunk(
    cfg: SharedTrunkCfg, *, obs_dim: int, device: torch.device | str | None = None
) -> TensorDictModule:
    """Build the layers as a TensorDict module, the common part of TorchRL's `ActorValueOperator`.

    Reads `cfg.in_keys`, `obs_dim` numbers side by side, and writes "features" [..., L].
    """
    network = TrunkNetwork(cfg, obs_dim=obs_dim, device=device)
    return TensorDictModule(network, in_keys=list(cfg.in_keys), out_keys=[FEATURES])
