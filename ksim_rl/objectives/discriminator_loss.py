"""The loss of a discriminator of motions, and the reward that it gives."""

from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.objectives.masked import masked_mean

Judge = Callable[[Float[Tensor, "B L"]], Float[Tensor, " B"]]


def discriminator_loss(
    judge: Judge,
    reference_CL: Float[Tensor, "C L"],
    policy_BL: Float[Tensor, "B L"],
    *,
    gradient_penalty: float,
    mask_B: Bool[Tensor, " B"] | None = None,
) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]]]:
    """Return the least-squares loss of a discriminator D with a gradient penalty, and the quantities to log.

    It is mean((D(r) - 1)^2) + mean((D(p) + 1)^2) + w / 2 mean(|dD(r)/dr|^2), r of the reference and p of the policy:
    equation 8 of Peng et al., arXiv 2104.02180, w the `gradient_penalty`, whose gradient needs D to be differentiable
    twice. Logged, detached, are `loss`, `penalty` (without w / 2), `reference_score`, `policy_score` (means of D), and
    `accuracy`, the share of transitions on their side of zero. With `mask_B` there are as many r as p (C is B), and the
    pairs where it is True count.
    """
    # The penalty is on the slope at the features, which therefore need a gradient as well.
    reference_CL = reference_CL.detach().requires_grad_()
    reference_C = judge(reference_CL)
    policy_B = judge(policy_BL)
    # Its gradient is a part of the loss, so it has to have one itself.
    (slope_CL,) = torch.autograd.grad(reference_C.sum(), reference_CL, create_graph=True)
    if mask_B is None:
        mean: Judge = torch.mean
    else:
        mean = partial(masked_mean, mask=mask_B)
    # The squared norm of the slope at each reference transition, averaged over them.
    penalty = mean(slope_CL.square().sum(-1))
    loss = mean((reference_C - 1.0).square()) + mean((policy_B + 1.0).square())
    loss = loss + 0.5 * gradient_penalty * penalty
    with torch.no_grad():
        # A transition counts as judged right if its score has the sign of its side.
        of_reference = mean((reference_C > 0.0).float())
        of_policy = mean((policy_B < 0.0).float())
        accuracy = (of_reference + of_policy) / 2
        logged = {
            "loss": loss.detach(),
            "penalty": penalty.detach(),
            "reference_score": mean(reference_C),
            "policy_score": mean(policy_B),
            "accuracy": accuracy,
        }
    return loss, logged


def style_reward(score: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return max(0, 1 - (D - 1)^2 / 4), in [0, 1]: equation 7 of arXiv 2104.02180."""
    return (1.0 - 0.25 * (score - 1.0).square()).clamp_min(0.0)
