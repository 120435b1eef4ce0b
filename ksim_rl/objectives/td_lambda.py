"""Lambda returns as value targets, without host syncs."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import value

from ksim_rl.objectives.rollout_estimator import RolloutEstimator, Signals, device_of, discounted_sum


class TDLambda(RolloutEstimator, value.TDLambdaEstimator):
    """Computes the lambda return as `value_target`, and `advantage`, which is what it exceeds the state value by.

    It is TorchRL's `TDLambdaEstimator` with the same keys and results (Sutton and Barto, Reinforcement Learning, 2nd
    ed., section 12.1); see `RolloutEstimator` for what differs. With G_t the return,
    G_t = r_t + gamma ((1 - lambda) V(s_{t+1}) + lambda G_{t+1}), cut at the end of an episode. In a rollout whose next
    observation is the observation of the next step, as collectors give it, the result is that of `GAE`; it is not where
    the two values differ, such as with the values of a target critic under "next".

    Args:
        gamma, lmbda, critic, normalize_advantage, time_dim, flatten, device: as those of `GAE`.
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
            value_network=critic,  # type: ignore[arg-type]
            vectorized=False,
            time_dim=time_dim,
            device=device_of(critic, device),
        )
        self.flatten, self.normalize_advantage = flatten, normalize_advantage

    def _estimate(self, signals: Signals, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        bootstrap = signals.discounted(signals.next_value, self.gamma)
        finite = (signals.reward + bootstrap - signals.state_value).isfinite()
        goes_on = finite & ~signals.done
        weight = torch.where(signals.done, torch.ones_like(bootstrap), 1.0 - self.lmbda)
        # Before a step that is not finite, the return is the value there.
        cut = signals.state_value.nan_to_num(0.0, 0.0, 0.0)
        last = -1 % signals.reward.shape[signals.time_dim]
        following = torch.where(goes_on, signals.next_value, 0.0).select(signals.time_dim, last)
        value_target = discounted_sum(
            torch.where(finite, signals.reward + weight * bootstrap, cut),
            goes_on * (self.gamma * self.lmbda),
            time_dim=signals.time_dim,
            following=following,
        )
        return value_target - signals.state_value, value_target, finite
