"""This module has the loss of twin delayed deterministic policy gradients, free of host syncs."""

from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.objectives.off_policy_loss import OffPolicyLoss, Scalar
from ksim_rl.objectives.target_network import frozen


class TD3Loss(OffPolicyLoss):
    """TD3 (Fujimoto et al., arXiv 1802.09477), and FastTD3 (Seo et al., arXiv 2505.22642) with a `support_A`.

    `loss_qvalue` = sum over the critics of mean((Q - y)^2), or of the cross entropy to the projected target
    distribution, y = r + gamma^n (1 - terminated) Q'(s', clip(a(s') + clip(noise))); `loss_actor` = -mean(Q(s, a(s))).
    As in FastTD3, a(s') is the present policy, not a slow copy of it.

    Args:
        actor_network: deterministic.
        critic_network, **options: see `OffPolicyLoss`.
        low_L, high_L: bounds of the actions.
        target_noise, target_noise_clip: standard deviation and bound of the noise on a(s'), in units of half the range
            of an action.
    """

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
        self.low_L, self.high_L = low_L, high_L
        self.target_noise, self.target_noise_clip = target_noise, target_noise_clip

    def critic_loss(self, tensordict: TensorDictBase) -> tuple[Scalar, dict[str, Scalar]]:
        """Return the loss of the critics, which has gradients for them alone, and what is logged beside it."""
        with torch.no_grad():
            following = tensordict.get("next").select(*self.actor_network.in_keys)
            action = self.actor_network(following).get(self.tensor_keys.action)
            noise = (torch.randn_like(action) * self.target_noise).clamp(
                -self.target_noise_clip, self.target_noise_clip
            )
            action = action + noise * (self.high_L - self.low_L) / 2
            next_action = torch.maximum(torch.minimum(action, self.high_L), self.low_L)
        return self._critic_loss(tensordict, next_action)

    def actor_losses(self, tensordict: TensorDictBase) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
        """Return the loss of the actor, which has gradients for it alone, and an empty dict."""
        observed = tensordict.select(*self.actor_network.in_keys)
        action = self.actor_network(observed).get(self.tensor_keys.action)
        with frozen(self.critic_network):
            value_B = self._value(tensordict, action)
        return {"loss_actor": -self._mean(value_B, tensordict)}, {}
