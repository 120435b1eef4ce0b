"""This module estimates generalized advantages without host syncs."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import value

from ksim_rl.objectives.rollout_estimator import RolloutEstimator, Signals, discounted_sum


class GAE(RolloutEstimator, value.GAE):
    """Computes `advantage` and `value_target` of a rollout (Schulman et al., arXiv 1506.02438).

    It is TorchRL's `GAE` with the same keys and results; see `RolloutEstimator` for what differs.

    Args:
        lmbda: weight of longer returns, in [0, 1].
        normalize_advantage, **options: of `RolloutEstimator`, gamma and critic among them.
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
