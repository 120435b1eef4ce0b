"""V-trace value targets and advantages, without host syncs."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    set_composite_lp_aggregate,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import value

from ksim_rl.objectives.rollout_estimator import (
    RolloutEstimator,
    Signals,
    device_of,
    discounted_sum,
    steps_of,
)


class VTrace(RolloutEstimator, value.VTrace):
    """Computes the targets of the present policy from a rollout of an older one (Espeholt et al., arXiv 1802.01561).

    `value_target` is V(s_t) + delta_t + gamma c_t (value_target_{t+1} - V(s_{t+1})) with
    delta_t = rho_t (r_t + gamma V(s_{t+1}) - V(s_t)), rho_t = min(rho_thresh, ratio_t) and
    c_t = lmbda min(c_thresh, ratio_t); `advantage` is rho_t (r_t + gamma value_target_{t+1} - V(s_t)), where the
    present policy took the action `ratio_t` times as often as the one that collected.

    It has the keys and the recursion of TorchRL's `VTrace`; see `RolloutEstimator` for what else differs. The present
    log-probability is that of the action in the data. (TorchRL's takes that of an action it draws anew, whose ratio
    has nothing to do with the data.)

    Args:
        gamma: discount per step, in [0, 1].
        actor: the present policy; what it reads, `action` and `action_log_prob` are in the data.
        lmbda: weight of longer returns, in [0, 1]; TorchRL's has 1.
        rho_thresh: bound of the ratio that decides whose value is learned, the present policy's at infinity.
        c_thresh: bound of the ratio that decides how far later steps count.
        critic, normalize_advantage, time_dim, flatten, device: as those of `GAE`.
    """

    lmbda: Tensor
    rho_thresh: Tensor
    c_thresh: Tensor

    def __init__(
        self,
        *,
        gamma: float,
        actor: ProbabilisticTensorDictSequential | None = None,
        critic: TensorDictModule | None = None,
        lmbda: float = 1.0,
        rho_thresh: float = 1.0,
        c_thresh: float = 1.0,
        normalize_advantage: bool = False,
        time_dim: int = -1,
        flatten: bool = True,
        device: torch.device | str | None = None,
        actor_network: ProbabilisticTensorDictSequential | None = None,
        value_network: TensorDictModule | None = None,
    ) -> None:
        actor = actor_network if actor is None else actor
        critic = value_network if critic is None else critic
        if actor is None:
            raise ValueError(
                "actor=None: V-trace needs the present policy, whose log-probabilities it compares"
            )
        super().__init__(
            gamma=gamma,
            actor_network=actor,
            value_network=critic,  # type: ignore[arg-type]
            rho_thresh=rho_thresh,
            c_thresh=c_thresh,
            average_adv=normalize_advantage,
            time_dim=time_dim,
            device=device_of(critic, device),
        )
        self.register_buffer("lmbda", torch.tensor(lmbda, device=device_of(critic, device)))
        self.flatten, self.normalize_advantage = flatten, normalize_advantage

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the data must have, or the arguments of a call without a TensorDict."""
        # Written out: the compiler cannot follow TorchRL's, which asks its base class for a property.
        keys, critic = self.tensor_keys, self.value_network
        observed = [keys.value] if critic is None else list(critic.in_keys)
        read = [
            *observed,
            *self.actor_network.in_keys,
            *self.actor_network.dist_sample_keys,
            keys.sample_log_prob,
        ]
        flags = [keys.reward, keys.done, keys.terminated]
        return list(dict.fromkeys([*read, *(("next", key) for key in [*observed, *flags])]))

    def _estimate(self, signals: Signals, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        time_dim, next_value = signals.time_dim, signals.next_value
        ratio = self._ratio(tensordict, signals)
        rho, c = ratio.clamp_max(self.rho_thresh), self.lmbda * ratio.clamp_max(self.c_thresh)
        delta = rho * (signals.reward + signals.discounted(next_value, self.gamma) - signals.state_value)
        finite = delta.isfinite()
        correction = discounted_sum(
            torch.where(finite, delta, torch.zeros_like(delta)),
            torch.where(finite & ~signals.done, self.gamma * c, torch.zeros_like(c)),
            time_dim=time_dim,
        )
        value_target = signals.state_value + correction
        following = _shifted(value_target, next_value, time_dim)
        # Past the end of an episode, of the rollout, or a step that is not finite there is the value only.
        known = ~signals.done & _shifted(finite, torch.zeros_like(finite), time_dim)
        following = torch.where(known, following, next_value)
        advantage = rho * (signals.reward + signals.discounted(following, self.gamma) - signals.state_value)
        return advantage, value_target, finite

    def _ratio(self, tensordict: TensorDictBase, signals: Signals) -> Tensor:
        actor, keys = self.actor_network, [*self.actor_network.in_keys, *self.actor_network.dist_sample_keys]
        with steps_of(actor):
            log_prob = self._in_rows(self._log_prob, tensordict.select(*keys), signals.time_dim)
        old_log_prob = tensordict.get(self.tensor_keys.sample_log_prob, None)
        if old_log_prob is None or old_log_prob.numel() != log_prob.numel():
            raise ValueError(
                f"VTrace needs {self.tensor_keys.sample_log_prob!r}, one number per step: got "
                f"{None if old_log_prob is None else tuple(old_log_prob.shape)} for {tuple(log_prob.shape)}; "
                f"the policy reads {actor.in_keys}"
            )
        return (log_prob.view_as(signals.reward) - old_log_prob.view_as(signals.reward)).exp()

    def _log_prob(self, rows: TensorDictBase) -> Tensor:
        dist = self.actor_network.get_dist(rows)
        if isinstance(dist, CompositeDistribution):
            with set_composite_lp_aggregate(True):
                return dist.log_prob(rows)
        (action_key,) = self.actor_network.dist_sample_keys
        return dist.log_prob(rows.get(action_key))


def _shifted(leaf: Tensor, last: Tensor, time_dim: int) -> Tensor:
    """Return the leaf one step later, [..., T, ...], and `last` at the last step."""
    length = leaf.shape[time_dim]
    return torch.cat((leaf.narrow(time_dim, 1, length - 1), last.narrow(time_dim, length - 1, 1)), time_dim)
