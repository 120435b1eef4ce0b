"""This module estimates lambda returns as value targets, without host syncs."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import value

from ksim_rl.objectives.rollout_estimator import RolloutEstimator, Signals, discounted_sum


class TDLambda(RolloutEstimator, value.TDLambdaEstimator):
    """Computes the lambda return as `value_target`, and `advantage`, which is what it exceeds the state value by.

    It is TorchRL's `TDLambdaEstimator` with the same keys and results (Sutton and Barto, Reinforcement Learning, 2nd
    ed., section 12.1); see `RolloutEstimator` for what differs. With G_t the return,
    G_t = r_t + gamma ((1 - lambda) V(s_{t+1}) + lambda G_{t+1}), cut at the end of an episode. In a rollout whose next
    observation is the observation of the next step, as collectors give it, the result is that of `GAE`; it is not where
    the two values differ, such as with the values of a target critic under "next".

    Args:
        lmbda: weight of longer returns, in [0, 1].
        **options: of `RolloutEstimator`, gamma and critic among them.
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
