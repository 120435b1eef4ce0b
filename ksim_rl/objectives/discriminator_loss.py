"""What a discriminator of motions learns, and the reward that it gives."""

from collections.abc import Callable

import torch
from torch import Tensor


def discriminator_loss(
    judge: Callable[[Tensor], Tensor],
    reference_BL: Tensor,
    policy_BL: Tensor,
    *,
    gradient_penalty: float,
    mask_B: Tensor | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the least-squares loss of a discriminator with a gradient penalty, and what is logged beside it.

    It is mean((D(r) - 1)^2) + mean((D(p) + 1)^2) + w / 2 mean(|dD(r)/dr|^2), r of the reference and p of the policy:
    equation 8 of Peng et al., arXiv 2104.02180. The penalty's gradient needs D to be differentiable twice.

    Args:
        judge: D, from [B, L] to [B].
        reference_BL, policy_BL: what D reads of transitions; their numbers may differ.
        gradient_penalty: w.
        mask_B: which of the policy's count, bool [B]; None is all.

    Returns:
        The loss, and `loss`, `penalty` (without w / 2), `reference_score`, `policy_score` (means of D), and `accuracy`,
        the share of transitions on their side of zero; each a tensor [], all but the loss detached.
    """
    reference_BL = reference_BL.detach().requires_grad_()
    reference_B, policy_B = judge(reference_BL), judge(policy_BL)
    # Its gradient is a part of the loss, so it has to have one itself.
    (slope_BL,) = torch.autograd.grad(reference_B.sum(), reference_BL, create_graph=True)
    penalty = slope_BL.square().sum(-1).mean()
    mask_B = torch.ones_like(policy_B, dtype=torch.bool) if mask_B is None else mask_B
    count = mask_B.sum().clamp_min(1)

    def mean_of_policy(values_B: Tensor) -> Tensor:
        return torch.where(mask_B, values_B, 0.0).sum() / count

    loss = (reference_B - 1.0).square().mean() + mean_of_policy((policy_B + 1.0).square())
    loss = loss + 0.5 * gradient_penalty * penalty
    with torch.no_grad():
        accuracy = ((reference_B > 0.0).float().mean() + mean_of_policy((policy_B < 0.0).float())) / 2
        logged = {
            "loss": loss.detach(),
            "penalty": penalty.detach(),
            "reference_score": reference_B.mean(),
            "policy_score": mean_of_policy(policy_B),
            "accuracy": accuracy,
        }
    return loss, logged


def style_reward(score: Tensor) -> Tensor:
    """Return max(0, 1 - (D - 1)^2 / 4), in [0, 1], for scores of any shape: equation 7 of arXiv 2104.02180."""
    return (1.0 - 0.25 * (score - 1.0).square()).clamp_min(0.0)
