"""This module has the loss of soft actor-critic, free of host syncs."""

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules.distributions.utils import rsample_and_log_prob

from ksim_rl.checks import check_in_range
from ksim_rl.objectives.off_policy_loss import OffPolicyLoss, Scalar
from ksim_rl.objectives.target_network import frozen


class SACLoss(OffPolicyLoss):
    """Soft actor-critic with a learned temperature (Haarnoja et al., arXiv 1812.05905), and FastSAC with a `support_A`.

    With values for critics and `value_reduction="min"` it has the losses and gradients of TorchRL's `SACLoss` with
    `loss_function="l2"`. All critics are evaluated in one batched product instead of a `vmap`, and may predict
    distributions.

    `loss_qvalue` = sum over the critics of mean((Q - y)^2), or of the cross entropy to the projected target
    distribution, y = r + gamma^n (1 - terminated) (Q'(s', a') - alpha log p(a'|s')); `loss_actor` = mean(alpha log
    p(a|s) - Q(s, a)); `loss_alpha` = -log_alpha * mean(log p(a|s) + target_entropy).

    Args:
        actor_network: probabilistic.
        critic_network, **options: see `OffPolicyLoss`.
        alpha_init: temperature at the start.
        learn_alpha: whether the temperature learns.
        target_entropy: that the temperature aims at, in nats.
    """

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
        log_alpha = torch.tensor(math.log(alpha_init), device=device)
        self.log_alpha = nn.Parameter(log_alpha, requires_grad=learn_alpha)

    @property
    def alpha(self) -> Scalar:
        """The temperature, without gradients."""
        return self.log_alpha.detach().exp()

    def critic_loss(self, tensordict: TensorDictBase) -> tuple[Scalar, dict[str, Scalar]]:
        """Return the loss of the critics, which has gradients for them alone, and what is logged beside it."""
        with torch.no_grad():
            following = tensordict.get("next").select(*self.actor_network.in_keys)
            next_action, log_prob_B = rsample_and_log_prob(self.actor_network.get_dist(following))
            bonus_B = -self.alpha * log_prob_B
        return self._critic_loss(tensordict, next_action, bonus_B)

    def actor_losses(self, tensordict: TensorDictBase) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
        """Return the losses of actor and temperature, each with gradients for it alone, and what is logged."""
        observed = tensordict.select(*self.actor_network.in_keys)
        action, log_prob_B = rsample_and_log_prob(self.actor_network.get_dist(observed))
        with frozen(self.critic_network):
            value_B = self._value(tensordict, action)
        log_prob = self._mean(log_prob_B.detach(), tensordict)
        losses = {
            "loss_actor": self._mean(self.alpha * log_prob_B - value_B, tensordict),
            "loss_alpha": -self.log_alpha * (log_prob + self.target_entropy),
        }
        return losses, {"alpha": self.alpha, "entropy": -log_prob}
