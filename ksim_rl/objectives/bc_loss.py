"""The loss that moves a policy towards recorded actions."""

from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictParams,
)
from tensordict.utils import NestedKey
from torch import nn
from torchrl import objectives
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.objectives.masked import MASK_KEY, mask_of, masked_mean
from ksim_rl.objectives.policy_kl import observation_keys
from ksim_rl.transforms.specs import path_of

DEMONSTRATION = "demonstration"
"""Under this key a dataset holds recorded env states, beside the rollout that the critic learns from."""
VALUE_TARGET = "value_target"


class BCLoss(objectives.BCLoss):
    """TorchRL's `BCLoss` of a policy with a distribution, by either of its two losses for continuous actions.

    `loss_bc` is the mean over env states of -log pi(a | s), in nats, with "nll"; with "mse" of the squared distance
    between a and the deterministic action, averaged over the action's numbers. Env states whose `("collector", "mask")`
    is False are left out. No value is read on the host, and nothing is drawn.
    """

    # The base declares the others; without this one each instance warns.
    target_actor_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        loss: Literal["nll", "mse"] = "nll",
    ) -> None:
        super().__init__(actor_network, loss_function="mse" if loss == "mse" else None)
        self._observation_keys = observation_keys(actor_network)

    @property
    def dataset_keys(self) -> list[NestedKey]:
        """The leaves that a dataset needs for this loss."""
        return [*self._observation_keys, "action"]

    def forward(self, minibatch_B: TensorDictBase) -> TensorDictBase:
        """Return `loss_bc` of a minibatch `["B"]` with the `dataset_keys`."""
        # The stock loss lets the policy act first; a deterministic action needs no draw, and is the one of "mse".
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return super().forward(minibatch_B)


class BCAndValueLoss(nn.Module):
    """`loss_bc` of recorded env states, and `loss_critic` of a rollout's: mean((v - value_target)^2).

    Each row of a minibatch `["B"]` has both, the recorded env state under "demonstration"; rows whose `("collector",
    "mask")` is False are left out of both. No value is read on the host.
    """

    def __init__(self, bc: BCLoss, critic: TensorDictModule) -> None:
        super().__init__()
        self.bc = bc
        self.critic = critic

    @property
    def dataset_keys(self) -> list[NestedKey]:
        """The leaves that a dataset needs for this loss."""
        recorded = [(DEMONSTRATION, *path_of(key)) for key in self.bc.dataset_keys]
        return [*recorded, *self.critic.in_keys, VALUE_TARGET]

    def forward(self, minibatch_B: TensorDictBase) -> TensorDictBase:
        """Return `loss_bc` and `loss_critic`."""
        recorded_B = minibatch_B.get(DEMONSTRATION).copy()
        if (mask_B := minibatch_B.get(MASK_KEY, None)) is not None:
            recorded_B.set(MASK_KEY, mask_B)
        losses = self.bc(recorded_B)
        valued_B = self.critic(minibatch_B.select(*self.critic.in_keys))
        error_B = (valued_B.get("state_value") - minibatch_B.get(VALUE_TARGET)).square()
        losses.set("loss_critic", masked_mean(error_B, mask_of(minibatch_B, error_B)))
        return losses
