"""Builds networks that judge: values of states and of actions, and how much transitions look like a motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Num
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import ValueOperator

from ksim_rl.checked import Count, NonNegative, numbers_of_layers
from ksim_rl.modules.mlp import Device, mlp
from ksim_rl.modules.network import (
    LayeredNetwork,
    NetworkCfg,
    ObservationKeys,
    ObservationNormalizer,
    ObservingNetwork,
    OffPolicyNetworkCfg,
)
from ksim_rl.modules.upstream import TensorModule


@dataclass(frozen=True, kw_only=True)
class CriticCfg(NetworkCfg):
    """The value network.

    Attributes:
        output_gain: scale of the last layer's weights.
    """

    in_keys: ObservationKeys = ("critic",)
    output_gain: NonNegative = 1.0


class ValueNetwork(LayeredNetwork):
    """Maps observations [..., L_i] to a state value [..., 1]."""

    def __init__(
        self, cfg: CriticCfg, *, obs_dim: int, encoded_dim: int = 0, device: Device = None
    ) -> None:
        super().__init__(
            cfg,
            obs_dim=obs_dim,
            encoded_dim=encoded_dim,
            output_dim=1,
            output_gain=cfg.output_gain,
            device=device,
        )


class Critic(TensorModule, ValueOperator):
    """TorchRL's `ValueOperator` of a network whose outputs are tensors."""


def make_critic(
    cfg: CriticCfg, *, obs_dim: int, encoded_dim: int = 0, device: Device = None
) -> ValueOperator:
    """Build the critic as TorchRL's `ValueOperator`.

    Reads `cfg.in_keys`, `obs_dim` numbers side by side, the last `encoded_dim` of which are features of encoders (see
    `make_for_spec`), and writes `state_value` [..., 1].
    """
    network = ValueNetwork(cfg, obs_dim=obs_dim, encoded_dim=encoded_dim, device=device)
    return Critic(network, in_keys=list(cfg.in_keys), out_keys=["state_value"])


@dataclass(frozen=True, kw_only=True)
class QNetworkCfg(OffPolicyNetworkCfg):
    """The action value networks, which differ in their first weights only; two for clipped double Q-learning.

    With `num_atoms` they predict probabilities of so many values, spread evenly over [v_min, v_max] (Bellemare et al.,
    arXiv 1707.06887); 1 predicts the value itself.
    """

    in_keys: ObservationKeys = ("critic",)
    num_networks: Count = 2  # critics side by side
    num_atoms: Count = 1  # values with a predicted probability each; 1 predicts the value
    v_min: float = -10.0  # the lowest atom
    v_max: float = 10.0  # the highest atom

    def _check_fields(self) -> None:
        super()._check_fields()
        # Checked without atoms as well, where the range is not used yet.
        if self.v_min >= self.v_max:
            raise ValueError(f"v_min={self.v_min!r} is not below v_max={self.v_max!r}")

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return what the layers of all networks need."""
        of_one = numbers_of_layers((*self.hidden_dims, self.num_atoms))
        return {("num_networks", "hidden_dims", "num_atoms"): self.num_networks * of_one}


class QNetwork(ObservingNetwork):
    """Maps observations and action [..., action_dim] to predictions of N networks, with atoms at `support`."""

    support: Tensor | None

    def __init__(
        self,
        cfg: QNetworkCfg,
        *,
        obs_dim: int,
        action_dim: int,
        encoded_dim: int = 0,
        device: Device = None,
    ) -> None:
        super().__init__(cfg, obs_dim=obs_dim, encoded_dim=encoded_dim, device=device)
        self.cfg = cfg
        support = torch.linspace(cfg.v_min, cfg.v_max, cfg.num_atoms, device=device)
        # It follows from the config, so that it is no part of a checkpoint.
        self.register_buffer("support", support if cfg.num_atoms > 1 else None, persistent=False)
        # Observations and action side by side are the inputs of the first layer.
        self.layers = cfg.build(
            obs_dim + action_dim, cfg.num_atoms, num_networks=cfg.num_networks, device=device
        )

    def forward(
        self, *inputs: Num[Tensor, "*batch ?L"]
    ) -> Float[Tensor, "*batch N"] | Float[Tensor, "*batch N A"]:
        """Return action values [..., N], or with atoms the logits of their probabilities [..., N, A].

        The inputs are observations, which stand side by side, and the action as the last one.
        """
        *observations, action = inputs
        # Actions are not normalized: the bounds of the env fix their range.
        features = torch.cat((self.observe(*observations), action), dim=-1)
        batch = features.shape[:-1]
        # One copy of the features for all networks, then [N, B, A] to [..., N, A].
        out = (
            self.layers(features.reshape(1, -1, features.shape[-1]))
            .transpose(0, 1)
            .unflatten(0, batch)
        )
        if self.support is None:
            return out.squeeze(-1)
        return out


def make_q_network(
    cfg: QNetworkCfg,
    *,
    obs_dim: int,
    action_dim: int,
    encoded_dim: int = 0,
    device: Device = None,
) -> TensorDictModule:
    """Build the networks as a TensorDict module, which reads `cfg.in_keys` and "action" [..., action_dim].

    It writes "state_action_value" [..., N], or with atoms "state_action_logits" [..., N, A]. `obs_dim` and
    `encoded_dim` are explained at `make_critic`.
    """
    network = QNetwork(
        cfg, obs_dim=obs_dim, encoded_dim=encoded_dim, action_dim=action_dim, device=device
    )
    # The key tells values from logits of the atoms.
    if cfg.num_atoms == 1:
        out_key = "state_action_value"
    else:
        out_key = "state_action_logits"
    return TensorModule(network, in_keys=[*cfg.in_keys, "action"], out_keys=[out_key])


class Discriminator(nn.Module):
    """Scores transitions [..., 2, L], the features before and after a step: 1 looks like the motions, -1 does not."""

    def __init__(
        self,
        dim: int,
        *,
        hidden_dims: Sequence[int] = (512, 256),
        activation: str = "relu",
        device: Device = None,
    ) -> None:
        super().__init__()
        self.normalizer = ObservationNormalizer(dim, device=device)
        # One normalizer for both frames: a feature has the same scale before and after the step.
        self.layers = mlp(2 * dim, hidden_dims, 1, activation=activation, device=device)

    def normalized(self, transition: Float[Tensor, "*batch 2 L"]) -> Float[Tensor, "*batch L+L"]:
        """Return the inputs of the layers for transitions: normalized, side by side."""
        return self.normalizer(transition).flatten(-2)

    def judge(self, normalized: Float[Tensor, "*batch L"]) -> Float[Tensor, "*batch"]:
        """Return the scores of normalized transitions."""
        return self.layers(normalized).squeeze(-1)

    def forward(self, transition: Float[Tensor, "*batch 2 L"]) -> Float[Tensor, "*batch"]:
        """Return the scores of transitions."""
        return self.judge(self.normalized(transition))
