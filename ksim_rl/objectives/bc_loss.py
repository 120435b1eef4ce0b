"""The loss that moves a policy towards recorded actions."""

from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictParams
from tensordict.utils import NestedKey
from torchrl import objectives
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.objectives.policy_kl import observation_keys


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
