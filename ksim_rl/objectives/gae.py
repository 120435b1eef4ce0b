"""Generalized advantage estimation without host syncs."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import value

from ksim_rl.objectives.rollout_estimator import RolloutEstimator, Signals, device_of, discounted_sum


class GAE(RolloutEstimator, value.GAE):
    """Computes `advantage` and `value_target` of a rollout (Schulman et al., arXiv 1506.02438).

    It is TorchRL's `GAE` with the same keys and results; see `RolloutEstimator` for what differs.

    Args:
        gamma: discount per step, in [0, 1].
        lmbda: weight of longer returns, in [0, 1].
        critic: any TensorDict module that writes `state_value` [..., 1]; None reads the values from the data.
        normalize_advantage: shift and scale the finite advantages to mean 0 and standard deviation 1 over all
            env states.
        time_dim: the batch dim that is time, whatever the names say; -1 is the last batch dim.
        flatten: give the critic all env states in one batch dim; False keeps the batch dims, e.g. for a
            recurrent one.
        device: of gamma and lmbda; None takes that of the critic.
    """

    def __init__(
        self,
        *,
        gamma: float,
        lmbda: float,
        critic: TensorDictModule | None = None,
        normalize_advantage: bool = False,
        time_dim: int = -1,
        flatten: bool = True,
        device: torch.device | str | None = None,
        value_network: TensorDictModule | None = None,
    ) -> None:
        critic = value_network if critic is None else critic
        super().__init__(
            gamma=gamma,
            lmbda=lmbda,
            value_network=critic,
            average_gae=normalize_advantage,
            vectorized=False,
            time_dim=time_dim,
            device=device_of(critic, device),
        )
        self.flatten, self.normalize_advantage = flatten, normalize_advantage

    def _estimate(self, signals: Signals, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        delta = signals.reward + signals.discounted(signals.next_value, self.gamma) - signals.state_value
        finite = delta.isfinite()
        discount = (finite & ~signals.done) * (self.gamma * self.lmbda)
        term = torch.where(finite, delta, torch.zeros_like(delta))
        advantage = discounted_sum(term, discount, time_dim=signals.time_dim)
        return advantage, advantage + signals.state_value, finite
