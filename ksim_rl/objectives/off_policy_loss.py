"""The losses of SAC and TD3, and the slow targets and distributed returns that they learn towards."""

import copy
import math
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    dispatch,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import LossModule

from ksim_rl import ranks
from ksim_rl.checked import Share, check_value
from ksim_rl.checks import check_in_range
from ksim_rl.objectives.algorithm_cfg import ValueReduction
from ksim_rl.objectives.distributional import compare, mean_returns
from ksim_rl.ranks.running_moments import RunningMoments


@contextmanager
def frozen(network: nn.Module) -> Iterator[None]:
    """Let gradients pass through a network in this block, but reach none of its weights."""
    learning = [parameter for parameter in network.parameters() if parameter.requires_grad]
    for parameter in learning:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)


Scalar = Float[Tensor, ""]


class OffPolicyLoss(LossModule):
    """The part of `SACLoss` and `TD3Loss` that is the same: how N critics learn, and how their values are read.

    The critics are one TensorDict module that reads observations and "action", and writes "state_action_value" [B, N],
    or "state_action_logits" [B, N, A] if there is a `support_A`: logits of the return's distribution on its A atoms.

    `loss_qvalue` = sum over the critics of mean((Q - y)^2), or of the cross entropy to the projected target
    distribution; the subclasses say what y is. Losses are means over the env states of a minibatch; those whose
    `("collector", "mask")` is False are left out, and `"priority_weight"` weighs them where it is present. No host
    syncs. `gamma` is the discount per step, of n steps where the data says "steps_to_next_obs"; `value_reduction` is
    explained in `OffPolicyCfg`.
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
    _written: ClassVar[tuple[str, ...]] = ("loss_qvalue", "loss_actor", "value", "td_error")
    tensor_keys: _AcceptedKeys  # type: ignore[assignment]
    actor_network: Any
    critic_network: TensorDictModule
    support_A: Tensor | None

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        critic_network: TensorDictModule,
        *,
        support_A: Float[Tensor, " A"] | None = None,
        gamma: float = 0.99,
        value_reduction: ValueReduction = "min",
    ) -> None:
        super().__init__()
        check_value("gamma", gamma, Share)
        check_value("value_reduction", value_reduction, ValueReduction)
        self.actor_network = actor_network
        self.critic_network = critic_network
        # Running statistics are shared: both networks see observations on the same scale at any time.
        shared: dict[int, RunningMoments] = {
            id(own): own for own in critic_network.modules() if isinstance(own, RunningMoments)
        }
        # Under a name that `parameters()` leaves out.
        self._target_critic = copy.deepcopy(critic_network, memo=shared).requires_grad_(False)
        # A buffer, which moves with the networks; it follows from the config, so it is no part of a checkpoint.
        self.register_buffer("support_A", support_A, persistent=False)
        self.gamma = gamma
        self.value_reduction: ValueReduction = value_reduction
        self.reduction = "mean"
        self._selected = list[NestedKey](self._written)

    @property
    def functional(self) -> bool:
        """False: the networks are used as they are."""
        return False

    @property
    def target_critic_network(self) -> TensorDictModule:
        """The critics that targets are computed with; they follow by `FlatAdamW` or `update_target_`."""
        return self._target_critic

    @property
    def observation_keys(self) -> list[NestedKey]:
        """The observations that actor and critics read, each key once."""
        read = dict.fromkeys([*self.actor_network.in_keys, *self.critic_network.in_keys])
        return [key for key in read if key != self.tensor_keys.action]

    @property
    def in_keys(self) -> list[NestedKey]:  # type: ignore[override]
        """The leaves that a minibatch must have."""
        keys = self.tensor_keys
        observed = self.observation_keys
        following = [*observed, keys.reward, keys.terminated]
        return [*observed, keys.action, *(unravel_key(("next", key)) for key in following)]

    @property
    def out_keys(self) -> list[NestedKey]:  # type: ignore[override]
        """The leaves that the forward returns, in the order of a call without a TensorDict; see `select_out_keys`."""
        return self._selected

    @out_keys.setter
    def out_keys(self, keys: list[NestedKey]) -> None:
        self._selected = keys

    def reset_parameters_recursive(self) -> None:
        """Draw the weights of the networks again; the targets begin as copies of the critics."""
        for network in (self.actor_network, self.critic_network):
            network.reset_parameters_recursive()
        self.update_target_(1.0)

    @abstractmethod
    def _next_action(self, following: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        """Return the actions of targets for the next observations, and the bonus on their values, [B] or None."""

    @abstractmethod
    def actor_losses(
        self, tensordict: TensorDictBase
    ) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
        """Return the other losses, each with gradients for its own network alone, and the quantities to log."""

    @dispatch  # type: ignore[arg-type]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return all losses, `loss_*`, and the logged quantities, which are detached.

        The minibatch `["B"]`, with the `in_keys`, gets the absolute error of each env state as "td_error".
        """
        loss_qvalue, logged = self.critic_loss(tensordict)
        losses, more = self.actor_losses(tensordict)
        detached = {name: value.detach() for name, value in (logged | more).items()}
        return TensorDict({"loss_qvalue": loss_qvalue, **losses, **detached})

    @torch.no_grad()
    def update_target_(self, tau: float) -> None:
        """Move the target critics by a share `tau` towards the critics, in a few kernels."""
        target = self._target_critic
        network = self.critic_network
        torch._foreach_lerp_(list(target.parameters()), list(network.parameters()), tau)

    def _forward_value_estimator_keys(self, **_: NestedKey) -> None:
        """There is no value estimator."""

    def _predict(
        self, critic: TensorDictModule, observed: TensorDictBase, action: Tensor
    ) -> Tensor:
        """Return N critics' predictions for an action: values [B, N], or logits [B, N, A] in the layers' dtype."""
        keys = [key for key in critic.in_keys if key != self.tensor_keys.action]
        # A selection is a new TensorDict, so the minibatch keeps the action of the data.
        inputs = observed.select(*keys).set(self.tensor_keys.action, action)
        predicted = critic(inputs)
        if self.support_A is None:
            out = predicted.get("state_action_value")
            # Errors of values are differences of large numbers: bfloat16 would lose most of their digits.
            return out.to(torch.promote_types(out.dtype, torch.float32))
        return predicted.get("state_action_logits")

    def _value(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Return the value of an action [B], which the actor climbs; no gradients reach the critics."""
        with frozen(self.critic_network):
            predicted = self._predict(self.critic_network, tensordict, action)
        if self.support_A is None:
            values_BN = predicted
        else:
            values_BN = mean_returns(predicted, self.support_A)
        if self.value_reduction == "min":
            return values_BN.amin(-1)
        return values_BN.mean(-1)

    def critic_loss(self, tensordict: TensorDictBase) -> tuple[Scalar, dict[str, Scalar]]:
        """Return the loss of the critics, which has gradients for them alone, and the quantities to log."""
        keys = self.tensor_keys
        following = tensordict.get("next")
        with torch.no_grad():
            # Targets: the policy's action at the next observation, judged by the slow copy of the critics.
            next_action, next_bonus_B = self._next_action(
                following.select(*self.actor_network.in_keys)
            )
            reward_B1 = following.get(keys.reward)
            # Only terminations end the future; after a truncation the value of the last observation still counts.
            going_B1 = 1.0 - following.get(keys.terminated).to(reward_B1.dtype)
            steps_B1 = tensordict.get(keys.steps_to_next_obs, None)
            # With n-step rewards the next observation lies `steps_B1` env steps ahead, at most n.
            if steps_B1 is None:
                discount_B1 = self.gamma * going_B1
            else:
                discount_B1 = self.gamma**steps_B1 * going_B1
            if next_bonus_B is not None:
                # The entropy bonus belongs to the next state, so it is discounted and cut like the value there.
                reward_B1 = reward_B1 + discount_B1 * next_bonus_B[:, None]
            next_predicted = self._predict(self._target_critic, following, next_action)
        # Gradients of the critics begin here: the target above is a constant.
        predicted = self._predict(self.critic_network, tensordict, tensordict.get(keys.action))
        if self.support_A is None:
            with torch.no_grad():
                target_BN = reward_B1 + discount_B1 * next_predicted
                # The smallest of the critics' values counters the overestimation by a policy that seeks their maximum.
                if self.value_reduction == "min":
                    target_BN = target_BN.amin(-1, keepdim=True)
            error_BN = predicted - target_BN
            values_BN = predicted
            loss_B = error_BN.square().sum(-1)
            td_error_B = error_BN.detach().abs().amax(-1)
        else:
            given = next_predicted, reward_B1, discount_B1, self.value_reduction
            loss_BN, values_BN = compare(predicted, self.support_A, *given)
            loss_B = loss_BN.sum(-1)
            # As in Rainbow (Hessel et al., arXiv 1710.02298), the loss itself is the priority.
            td_error_B = loss_BN.detach().amax(-1)
        # Prioritized replay reads the error of each env state from here.
        tensordict.set(keys.priority, td_error_B)
        return self._mean(loss_B, tensordict), {
            "value": self._mean(values_BN.detach().mean(-1), tensordict),
            "td_error": self._mean(td_error_B, tensordict),
        }

    def _mean(self, column_B: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Return the mean over the env states that take part, weighed by their priority weights."""
        weight_B = tensordict.get(self.tensor_keys.priority_weight, None)
        if weight_B is None:
            weight_B = torch.ones_like(column_B)
        else:
            # Priority weights are stored as [B, 1].
            weight_B = weight_B.reshape(column_B.shape)
        for key in self._loss_mask_keys():
            mask = tensordict.get(key, None)
            if mask is not None:
                weight_B = weight_B * self._expand_loss_mask(mask, column_B)
        # A where instead of a product: a value that is left out may be anything, and zero times infinity is NaN.
        column_B = torch.where(weight_B > 0.0, column_B * weight_B, 0.0)
        # In two steps: the compiler makes one block of a sum to 8192 numbers, which takes three times as long.
        parts = math.gcd(len(column_B), 64)
        column_sum, weight_sum = (
            own.reshape(parts, -1).sum(-1).sum() for own in (column_B, weight_B)
        )
        # If no env state takes part both sums are zero, and so is the mean.
        return column_sum / weight_sum.clamp_min(torch.finfo(torch.float32).tiny)


class SACLoss(OffPolicyLoss):
    """Soft actor-critic with a learned temperature (Haarnoja et al., arXiv 1812.05905), and FastSAC with a `support_A`.

    With values for critics and `value_reduction="min"` it has the losses and gradients of TorchRL's `SACLoss` with
    `loss_function="l2"`. All critics are evaluated in one batched product instead of a `vmap`, and may predict
    distributions. The temperature starts at `alpha_init` and aims at `target_entropy`, in nats.

    y = r + gamma^n (1 - terminated) (Q'(s', a') - alpha log p(a'|s')); `loss_actor` = mean(alpha log p(a|s) - Q(s, a));
    `loss_alpha` = -log_alpha * mean(log p(a|s) + target_entropy).
    """

    _written = ("loss_qvalue", "loss_actor", "loss_alpha", "value", "td_error", "alpha", "entropy")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        *,
        target_entropy: float,
        alpha_init: float = 1.0,
        learn_alpha: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(actor_network, critic_network, **options)
        check_in_range("alpha_init", alpha_init, low=0.0, low_open=True)
        check_in_range("target_entropy", target_entropy)
        self.target_entropy = target_entropy
        device = next(critic_network.parameters()).device
        # The logarithm is learned, so that the temperature stays positive under any step.
        log_alpha = torch.tensor(math.log(alpha_init), device=device)
        self.log_alpha = nn.Parameter(log_alpha, requires_grad=learn_alpha)

    @property
    def alpha(self) -> Scalar:
        """The temperature, without gradients."""
        return self.log_alpha.detach().exp()

    def _next_action(self, following: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        next_action, log_prob_B = rsample_and_log_prob(self.actor_network.get_dist(following))
        return next_action, -self.alpha * log_prob_B

    def actor_losses(
        self, tensordict: TensorDictBase
    ) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
        """Return the losses of actor and temperature, each with gradients for it alone, and the quantities to log."""
        observed = tensordict.select(*self.actor_network.in_keys)
        action, log_prob_B = rsample_and_log_prob(self.actor_network.get_dist(observed))
        value_B = self._value(tensordict, action)
        log_prob = self._mean(log_prob_B.detach(), tensordict)
        losses = {
            "loss_actor": self._mean(self.alpha * log_prob_B - value_B, tensordict),
            "loss_alpha": -self.log_alpha * (log_prob + self.target_entropy),
        }
        return losses, {"alpha": self.alpha, "entropy": -log_prob}


class TD3Loss(OffPolicyLoss):
    """TD3 (Fujimoto et al., arXiv 1802.09477), and FastTD3 (Seo et al., arXiv 2505.22642) with a `support_A`.

    y = r + gamma^n (1 - terminated) Q'(s', clip(a(s') + clip(noise))); `loss_actor` = -mean(Q(s, a(s))). As in FastTD3,
    a(s') is the present policy, not a slow copy of it. `target_noise` and `target_noise_clip` are the standard
    deviation and the bound of the noise, in units of half the range [low_L, high_L] of an action.
    """

    low_L: Tensor
    high_L: Tensor

    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        critic_network: TensorDictModule,
        *,
        low_L: Float[Tensor, " L"],
        high_L: Float[Tensor, " L"],
        target_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        **options: Any,
    ) -> None:
        super().__init__(actor_network, critic_network, **options)
        check_in_range("target_noise", target_noise, low=0.0)
        check_in_range("target_noise_clip", target_noise_clip, low=0.0)
        # Buffers, which move with the networks; they are the env's, so they are no part of a checkpoint.
        self.register_buffer("low_L", low_L, persistent=False)
        self.register_buffer("high_L", high_L, persistent=False)
        self.target_noise = target_noise
        self.target_noise_clip = target_noise_clip

    def _next_action(self, following: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        action = self.actor_network(following).get(self.tensor_keys.action)
        # The target policy is smoothed: a critic must not be trusted at one sharp peak of its value.
        noise = (ranks.randn(action.shape, device=action.device) * self.target_noise).clamp(
            -self.target_noise_clip, self.target_noise_clip
        )
        # Noise is in units of half the range, so that one setting fits actions of any units.
        action = action + noise * (self.high_L - self.low_L) / 2
        # Noise may leave the box of the env's actions, beyond which the critics have learned nothing.
        return torch.maximum(torch.minimum(action, self.high_L), self.low_L), None

    def actor_losses(
        self, tensordict: TensorDictBase
    ) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
        """Return the loss of the actor, which has gradients for it alone, and an empty dict."""
        observed = tensordict.select(*self.actor_network.in_keys)
        action = self.actor_network(observed).get(self.tensor_keys.action)
        return {"loss_actor": -self._mean(self._value(tensordict, action), tensordict)}, {}
