"""Builds policies whose actions lie in a box: TD3's deterministic one and SAC's squashed gaussian."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Num
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor

from ksim_rl.checked import Count, NonNegative, Positive
from ksim_rl.modules.action_heads import action_range
from ksim_rl.modules.distributions import TanhGaussian
from ksim_rl.modules.mlp import Device
from ksim_rl.modules.network import ObservingNetwork, OffPolicyNetworkCfg
from ksim_rl.modules.upstream import TensorModule


@dataclass(frozen=True, kw_only=True)
class BoundedActorCfg(OffPolicyNetworkCfg):
    """The fields of policies whose actions lie in a box, within `action_bound` where the env's spec has no bounds."""

    output_gain: NonNegative = 0.01
    action_bound: Positive = 1.0  # where the spec has no bounds


@dataclass(frozen=True, kw_only=True)
class DeterministicActorCfg(BoundedActorCfg):
    """The policy of TD3: one action for each observation."""

    hidden_dims: tuple[Count, ...] = (512, 256, 128)


@dataclass(frozen=True, kw_only=True)
class SquashedActorCfg(BoundedActorCfg):
    """The policy of SAC: a gaussian squashed by tanh, whose standard deviation depends on the observation.

    `log_std_min` and `log_std_max` bound the log of the standard deviation before squashing.
    """

    log_std_min: float = -5.0  # lower bound of the log of the standard deviation
    log_std_max: float = 2.0  # upper bound

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.log_std_min >= self.log_std_max:
            raise ValueError(
                f"log_std_min={self.log_std_min!r} is not below log_std_max={self.log_std_max!r}"
            )


class BoundedActor(ObservingNetwork):
    """Normalization, hidden layers, and a last layer: [..., L_i] to [..., outputs_per_action * action_dim]."""

    outputs_per_action: ClassVar[int] = 1
    low: Tensor
    high: Tensor

    def __init__(
        self,
        cfg: BoundedActorCfg,
        *,
        obs_dim: int,
        action_spec: TensorSpec,
        encoded_dim: int = 0,
        device: Device = None,
    ) -> None:
        super().__init__(cfg, obs_dim=obs_dim, encoded_dim=encoded_dim, device=device)
        self.cfg = cfg
        # Persistent buffers: a checkpoint for other bounds is refused by them.
        low, high = action_range(action_spec, cfg.action_bound, device=device)
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.layers = cfg.build(
            obs_dim, self.outputs_per_action * action_spec.shape[-1], device=device
        )

    def output(self, *observations: Num[Tensor, "*batch ?L"]) -> Float[Tensor, "*batch output_dim"]:
        """Return the outputs of the last layer, in float32 at least."""
        # Half precision would round the squashed action, and its density.
        out = self.layers(self.observe(*observations))
        return out.to(torch.promote_types(out.dtype, torch.float32))


class DeterministicPolicy(BoundedActor):
    """Maps observations [..., L_i] to the action [..., action_dim]."""

    def forward(
        self, *observations: Num[Tensor, "*batch ?L"]
    ) -> Float[Tensor, "*batch action_dim"]:
        """Return the action, in [low, high]."""
        center = (self.high + self.low) / 2
        half_range = (self.high - self.low) / 2
        # The tanh keeps actions in the box, and lets gradients through everywhere.
        return center + half_range * self.output(*observations).tanh()


class SquashedPolicy(BoundedActor):
    """Maps observations [..., L_i] to `loc` and `scale` before squashing, each [..., action_dim]."""

    outputs_per_action = 2
    cfg: SquashedActorCfg

    def forward(
        self, *observations: Num[Tensor, "*batch ?L"]
    ) -> tuple[Float[Tensor, "*batch action_dim"], Float[Tensor, "*batch action_dim"]]:
        """Return `(loc, scale)`."""
        # The first half of the outputs are means, the second one become standard deviations.
        loc, raw = self.output(*observations).chunk(2, dim=-1)
        # A tanh instead of a clamp: the gradient never vanishes wholly at a bound.
        low = self.cfg.log_std_min
        high = self.cfg.log_std_max
        return loc, (low + 0.5 * (high - low) * (raw.tanh() + 1.0)).exp()

    def distribution(
        self, loc: Float[Tensor, "*batch action_dim"], scale: Float[Tensor, "*batch action_dim"]
    ) -> TanhGaussian:
        """Return the distribution of actions within this policy's bounds."""
        return TanhGaussian(loc, scale, low=self.low, high=self.high)


def make_deterministic_actor(cfg: DeterministicActorCfg, **network: Any) -> TensorDictModule:
    """Build a policy that reads `cfg.in_keys` and writes "action" [..., action_dim], within the bounds of the spec."""
    policy = DeterministicPolicy(cfg, **network)
    return TensorModule(policy, in_keys=list(cfg.in_keys), out_keys=["action"])


def make_squashed_actor(cfg: SquashedActorCfg, **network: Any) -> ProbabilisticActor:
    """Build the policy as TorchRL's `ProbabilisticActor`, within the spec's bounds.

    It reads `cfg.in_keys`, `obs_dim` numbers side by side, and writes `loc`, `scale` (before squashing) and `action`
    [..., action_dim]. It samples unless TorchRL's exploration type says otherwise; `ExplorationType.DETERMINISTIC`
    gives the median.
    """
    policy = SquashedPolicy(cfg, **network)
    return ProbabilisticActor(
        TensorModule(policy, in_keys=list(cfg.in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["action"],
        # A method, so that the bounds are the policy's wherever it is moved or copied.
        distribution_class=policy.distribution,  # type: ignore[arg-type]
        default_interaction_type=ExplorationType.RANDOM,
    )
