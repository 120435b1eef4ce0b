"""This module has what the losses of off-policy learning share: critics, their targets, and means over a minibatch."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.objectives.distributional import cross_entropy, mean_of, project_distribution
from ksim_rl.objectives.off_policy_cfg import VALUE_REDUCTIONS
from ksim_rl.objectives.target_network import follow_, make_target

Scalar = Float[Tensor, ""]


class OffPolicyLoss(LossModule):
    """The part of `SACLoss` and `TD3Loss` that is the same: how N critics learn, and what their values say.

    The critics are one TensorDict module that reads observations and "action", and writes
    "state_action_value" [B, N], or "state_action_logits" [B, N, A] if there is a `support_A`: logits of the return's
    distribution on its A atoms.

    Losses are sums over the N networks and means over the env states of a minibatch; those whose
    `("collector", "mask")` is False are left out, and `"priority_weight"` weighs them where it is present. No host
    syncs.

    Args:
        actor_network: reads observations, writes "action".
        critic_network: as above.
        support_A: the values of the atoms; None if the critics predict values.
        gamma: discount per step; of n steps where the data says "steps_to_next_obs".
        value_reduction: "min" or "mean"; see `OffPolicyCfg`.
    """

    @dataclass
    class _AcceptedKeys:
        """The keys that `set_keys` changes."""

        action: NestedKey = "action"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys  # type: ignore[assignment]
    actor_network: Any
    critic_network: Any

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        critic_network: TensorDictModule,
        *,
        support_A: Float[Tensor, " A"] | None = None,
        gamma: float = 0.99,
        value_reduction: str = "min",
    ) -> None:
        super().__init__()
        check_in_range("gamma", gamma, low=0.0, high=1.0)
        check_choice("value_reduction", value_reduction, VALUE_REDUCTIONS)
        self.actor_network, self.critic_network = actor_network, critic_network
        # Under a name that `parameters()` leaves out.
        self._target_critic = make_target(critic_network)
        self.support_A, self.gamma, self.value_reduction = support_A, gamma, value_reduction
        self.reduction = "mean"

    @property
    def functional(self) -> bool:
        """False: the networks are used as they are."""
        return False

    @property
    def target_critic_network(self) -> TensorDictModule:
        """The critics that targets are computed with; they change by `update_target_` only."""
        return self._target_critic

    @property
    def in_keys(self) -> list[NestedKey]:  # type: ignore[override]
        """What a minibatch must have."""
        keys = self.tensor_keys
        observed = [key for key in self.critic_network.in_keys if key != keys.action]
        observed = list(dict.fromkeys([*self.actor_network.in_keys, *observed]))
        following = [*observed, keys.reward, keys.terminated]
        return [*observed, keys.action, *(_next(key) for key in following)]

    def critic_loss(self, tensordict: TensorDictBase) -> tuple[Scalar, dict[str, Scalar]]:
        """Return the loss of the critics, which has gradients for them alone, and what is logged beside it."""
        raise NotImplementedError

    def actor_losses(self, tensordict: TensorDictBase) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
        """Return the losses of all else, each with gradients for its own network alone, and what is logged."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return all losses, `loss_*`, and what is logged beside them, which is detached.

        Args:
            tensordict: a minibatch `["B"]` with the `in_keys`. Gets the absolute error of each env state as "td_error".
        """
        loss_qvalue, logged = self.critic_loss(tensordict)
        losses, more = self.actor_losses(tensordict)
        detached = {name: value.detach() for name, value in (logged | more).items()}
        return TensorDict({"loss_qvalue": loss_qvalue, **losses, **detached})

    def update_target_(self, tau: float) -> None:
        """Move the target critics by a share `tau` towards the critics."""
        follow_(self._target_critic, self.critic_network, tau)

    def _forward_value_estimator_keys(self, **_: NestedKey) -> None:
        """There is no value estimator."""

    def _predict(self, critic: TensorDictModule, observed: TensorDictBase, action: Tensor) -> Tensor:
        """Return what the N critics say of an action: values [B, N], or logits [B, N, A]."""
        keys = [key for key in critic.in_keys if key != self.tensor_keys.action]
        inputs = observed.select(*keys).set(self.tensor_keys.action, action)
        return critic(inputs).get(critic.out_keys[0]).float()

    def _value(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Return the value of an action [B], which the actor climbs."""
        predicted = self._predict(self.critic_network, tensordict, action)
        values_BN = predicted if self.support_A is None else mean_of(predicted.softmax(-1), self.support_A)
        return values_BN.amin(-1) if self.value_reduction == "min" else values_BN.mean(-1)

    def _critic_loss(
        self, tensordict: TensorDictBase, next_action: Tensor, next_bonus_B: Tensor | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of the critics, for the actions that follow and what is added to their values."""
        keys = self.tensor_keys
        following = tensordict.get("next")
        with torch.no_grad():
            reward_B1 = following.get(keys.reward)
            going_B1 = 1.0 - following.get(keys.terminated).to(reward_B1.dtype)
            steps_B1 = tensordict.get(keys.steps_to_next_obs, None)
            discount_B1 = self.gamma * going_B1 if steps_B1 is None else self.gamma**steps_B1 * going_B1
            if next_bonus_B is not None:
                reward_B1 = reward_B1 + discount_B1 * next_bonus_B[:, None]
            next_predicted = self._predict(self._target_critic, following, next_action)
        predicted = self._predict(self.critic_network, tensordict, tensordict.get(keys.action))
        if self.support_A is None:
            with torch.no_grad():
                target_BN = reward_B1 + discount_B1 * next_predicted
                if self.value_reduction == "min":
                    target_BN = target_BN.amin(-1, keepdim=True)
            error_BN = predicted - target_BN
            values_BN, loss_B = predicted, error_BN.square().sum(-1)
            td_error_B = error_BN.detach().abs().amax(-1)
        else:
            with torch.no_grad():
                target_BNA = project_distribution(
                    next_predicted.softmax(-1), reward_B1[:, None], discount_B1[:, None], self.support_A
                )
                if self.value_reduction == "min":
                    lowest_B11 = mean_of(target_BNA, self.support_A).argmin(-1)[:, None, None]
                    target_BNA = target_BNA.take_along_dim(lowest_B11, dim=1).expand_as(predicted)
                values_BN = mean_of(predicted.softmax(-1), self.support_A)
            loss_BN = cross_entropy(predicted, target_BNA)
            loss_B = loss_BN.sum(-1)
            # As in Rainbow (Hessel et al., arXiv 1710.02298), what is minimized is the priority.
            td_error_B = loss_BN.detach().amax(-1)
        tensordict.set(keys.priority, td_error_B)
        return self._mean(loss_B, tensordict), {
            "value": self._mean(values_BN.detach().mean(-1), tensordict),
            "td_error": self._mean(td_error_B, tensordict),
        }

    def _mean(self, column_B: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Return the mean over the env states that take part, weighed by their priority weights."""
        weight_B = tensordict.get(self.tensor_keys.priority_weight, None)
        weight_B = torch.ones_like(column_B) if weight_B is None else weight_B.reshape(column_B.shape)
        for key in self._loss_mask_keys():
            mask = tensordict.get(key, None)
            if mask is not None:
                weight_B = weight_B * self._expand_loss_mask(mask, column_B)
        # A where instead of a product: what is left out may be anything, and zero times infinity is NaN.
        column_B = torch.where(weight_B > 0.0, column_B * weight_B, 0.0)
        return column_B.sum() / weight_B.sum().clamp_min(torch.finfo(torch.float32).tiny)


def _next(key: NestedKey) -> tuple[str, ...]:
    return ("next", key) if isinstance(key, str) else ("next", *key)  # type: ignore[misc]
