"""This module has the estimators of advantages: GAE, lambda returns and V-trace, without host syncs."""

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import CompositeDistribution, ProbabilisticTensorDictSequential, set_composite_lp_aggregate
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import value

from ksim_rl.objectives.rollout_estimator import RolloutEstimator, Signals, discounted_sum, steps_of


class GAE(RolloutEstimator, value.GAE):
    """Computes `advantage` and `value_target` of a rollout (Schulman et al., arXiv 1506.02438).

    It is TorchRL's `GAE` with the same keys and results; see `RolloutEstimator` for what differs.
    """

    def __init__(self, *, lmbda: float, normalize_advantage: bool = False, **options: Any) -> None:
        super().__init__(
            lmbda=lmbda,
            normalize_advantage=normalize_advantage,
            average_gae=normalize_advantage,
            vectorized=False,
            **options,
        )

    def _estimate(self, signals: Signals, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        bootstrap_ET = signals.bootstrap(signals.value_ET_t_plus_1, self.gamma)
        delta_ET = signals.reward_ET + bootstrap_ET - signals.value_ET_t
        finite_ET = delta_ET.isfinite()
        adv_ET = discounted_sum(
            torch.where(finite_ET, delta_ET, torch.zeros_like(delta_ET)),
            (finite_ET & ~signals.done_ET) * (self.gamma * self.lmbda),
            time_dim=signals.time_dim,
        )
        return adv_ET, adv_ET + signals.value_ET_t, finite_ET


class TDLambda(RolloutEstimator, value.TDLambdaEstimator):
    """Computes the lambda return as `value_target`, and `advantage`, which is what it exceeds the state value by.

    It is TorchRL's `TDLambdaEstimator` with the same keys and results (Sutton and Barto, Reinforcement Learning, 2nd
    ed., section 12.1); see `RolloutEstimator` for what differs. With G_t the return,
    G_t = r_t + gamma ((1 - lambda) V(s_{t+1}) + lambda G_{t+1}), cut at the end of an episode. In a rollout whose next
    observation is the observation of the next step, as collectors give it, the result is that of `GAE`; it is not where
    the two values differ, such as with the values of a target critic under "next".
    """

    def __init__(self, *, lmbda: float, **options: Any) -> None:
        super().__init__(lmbda=lmbda, vectorized=False, **options)

    def _estimate(self, signals: Signals, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        bootstrap_ET = signals.bootstrap(signals.value_ET_t_plus_1, self.gamma)
        finite_ET = (signals.reward_ET + bootstrap_ET - signals.value_ET_t).isfinite()
        goes_on_ET = finite_ET & ~signals.done_ET
        weight_ET = torch.where(signals.done_ET, torch.ones_like(bootstrap_ET), 1.0 - self.lmbda)
        # Before a step that is not finite, the return is the value there.
        cut_ET = signals.value_ET_t.nan_to_num(0.0, 0.0, 0.0)
        last = -1 % signals.reward_ET.shape[signals.time_dim]
        following_ET = torch.where(goes_on_ET, signals.value_ET_t_plus_1, 0.0)
        target_ET = discounted_sum(
            torch.where(finite_ET, signals.reward_ET + weight_ET * bootstrap_ET, cut_ET),
            goes_on_ET * (self.gamma * self.lmbda),
            time_dim=signals.time_dim,
            last_E=following_ET.select(signals.time_dim, last),
        )
        return target_ET - signals.value_ET_t, target_ET, finite_ET


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
        actor: the present policy; what it reads, `action` and `action_log_prob` are in the data.
        lmbda: TorchRL's has 1.
        **options: of `RolloutEstimator`; and of TorchRL's `VTrace`: `rho_thresh`, the bound of the ratio that decides
            whose value is learned (the present policy's at infinity), and `c_thresh`, of the one that decides how far
            later steps count.
    """

    lmbda: Tensor
    rho_thresh: Tensor
    c_thresh: Tensor

    def __init__(
        self,
        *,
        actor: ProbabilisticTensorDictSequential | None = None,
        lmbda: float = 1.0,
        normalize_advantage: bool = False,
        actor_network: ProbabilisticTensorDictSequential | None = None,
        **options: Any,
    ) -> None:
        actor = actor_network if actor is None else actor
        if actor is None:
            raise ValueError(
                "actor=None: V-trace needs the present policy, whose log-probabilities it compares"
            )
        super().__init__(
            actor_network=actor,
            normalize_advantage=normalize_advantage,
            average_adv=normalize_advantage,
            **options,
        )
        self.register_buffer("lmbda", torch.tensor(lmbda, device=self.gamma.device))

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
        time_dim, value_ET_t_plus_1 = signals.time_dim, signals.value_ET_t_plus_1
        ratio_ET = self._ratio(tensordict, signals)
        rho_ET, c_ET = ratio_ET.clamp_max(self.rho_thresh), self.lmbda * ratio_ET.clamp_max(self.c_thresh)
        bootstrap_ET = signals.bootstrap(value_ET_t_plus_1, self.gamma)
        delta_ET = rho_ET * (signals.reward_ET + bootstrap_ET - signals.value_ET_t)
        finite_ET = delta_ET.isfinite()
        correction_ET = discounted_sum(
            torch.where(finite_ET, delta_ET, torch.zeros_like(delta_ET)),
            torch.where(finite_ET & ~signals.done_ET, self.gamma * c_ET, torch.zeros_like(c_ET)),
            time_dim=time_dim,
        )
        target_ET = signals.value_ET_t + correction_ET
        # Past the end of an episode, of the rollout, or a step that is not finite there is the value only.
        known_ET = ~signals.done_ET & _shifted(finite_ET, torch.zeros_like(finite_ET), time_dim)
        target_ET_t_plus_1 = _shifted(target_ET, value_ET_t_plus_1, time_dim)
        target_ET_t_plus_1 = torch.where(known_ET, target_ET_t_plus_1, value_ET_t_plus_1)
        bootstrap_ET = signals.bootstrap(target_ET_t_plus_1, self.gamma)
        return rho_ET * (signals.reward_ET + bootstrap_ET - signals.value_ET_t), target_ET, finite_ET

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
        return (log_prob.view_as(signals.reward_ET) - old_log_prob.view_as(signals.reward_ET)).exp()

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
