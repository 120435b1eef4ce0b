"""Projects the targets of critics that predict a distribution of returns, and compares them."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from ksim_rl.objectives.algorithm_cfg import ValueReduction


def compare(
    logits_BNA: Float[Tensor, "B N A"],
    support_A: Float[Tensor, " A"],
    following_BNA: Float[Tensor, "B N A"],
    reward_B1: Float[Tensor, "B 1"],
    discount_B1: Float[Tensor, "B 1"],
    reduction: ValueReduction,
) -> tuple[Float[Tensor, "B N"], Float[Tensor, "B N"]]:
    """Return the cross entropies of N critics to their targets, and the means that they predict, without gradients.

    Targets are the projected distributions of the logits that follow: each critic has its own, or with "min" all have
    the one of the lowest mean. On CUDA it is one kernel, gradients included, and the same bits each time.
    """
    if logits_BNA.is_cuda:
        given = following_BNA, reward_B1, discount_B1, reduction == "min"
        loss_BN, mean_BN = _by_kernel(logits_BNA, support_A, *given)
        return loss_BN, mean_BN.detach()
    # On the CPU: the same quantities step by step, in float32 at least.
    logits_BNA = _exact(logits_BNA)
    with torch.no_grad():
        probs_BNA = _exact(following_BNA).softmax(-1)
        moves = (reward_B1[:, None], discount_B1[:, None])
        target_BNA = project_distribution(probs_BNA, *moves, support_A)
        if reduction == "min":
            # All critics learn towards the distribution of the one whose mean is lowest.
            lowest_B11 = mean_of(target_BNA, support_A).argmin(-1)[:, None, None]
            target_BNA = target_BNA.take_along_dim(lowest_B11, dim=1).expand_as(logits_BNA)
    losses_BN = functional.cross_entropy(logits_BNA.mT, target_BNA.mT, reduction="none")
    return losses_BN, mean_of(logits_BNA.detach().softmax(-1), support_A)


def mean_returns(
    logits_BNA: Float[Tensor, "B N A"], support_A: Float[Tensor, " A"]
) -> Float[Tensor, "B N"]:
    """Return the means of the distributions with these logits, by one kernel on CUDA."""
    if logits_BNA.is_cuda:
        return _by_kernel(logits_BNA, support_A)[0]
    return mean_of(_exact(logits_BNA).softmax(-1), support_A)


def _by_kernel(*given: Tensor | bool) -> tuple[Tensor, Tensor]:
    # Not above: Triton comes with torch for CUDA only.
    from ksim_rl.objectives.distribution_kernel import Compared

    return Compared.apply(*given)


def _exact(logits: Tensor) -> Tensor:
    return logits.to(torch.promote_types(logits.dtype, torch.float32))


def project_distribution(
    probs: Float[Tensor, "*batch A"],
    reward: Float[Tensor, "#*batch 1"],
    discount: Float[Tensor, "#*batch 1"],
    support_A: Float[Tensor, " A"],
) -> Float[Tensor, "*batch A"]:
    """Return the distribution of `reward + discount * z` on the atoms, for `z` distributed as `probs`.

    The mass of each moved atom goes to the two atoms that it falls between, in proportion to how near they are; beyond
    the ends it goes to the last atom (algorithm 1 of Bellemare et al., arXiv 1707.06887). `support_A` has the values of
    the atoms, evenly spaced, rising.
    """
    low = support_A[0]
    high = support_A[-1]
    count = support_A.shape[0]
    spacing = (high - low) / (count - 1)
    # In units of the spacing between atoms, [*batch, A], from 0 to A - 1.
    position = ((reward + discount * support_A).clamp(low, high) - low) / spacing
    # The last atom itself counts as the upper neighbour of the one before, so that no index runs over the end.
    lower = position.floor().clamp(0, count - 2)
    upper_share = position - lower
    lower_index = lower.to(torch.int64).expand_as(probs)
    # Several atoms may fall between the same two, so that their masses have to be added up.
    projected = torch.zeros_like(probs)
    projected.scatter_add_(-1, lower_index, probs * (1.0 - upper_share))
    projected.scatter_add_(-1, lower_index + 1, probs * upper_share)
    return projected


def mean_of(
    probs: Float[Tensor, "*batch A"], support_A: Float[Tensor, " A"]
) -> Float[Tensor, "*batch"]:
    """Return the means of distributions."""
    # No product of matrices: autocast would round it to bfloat16.
    return (probs * support_A).sum(-1)
