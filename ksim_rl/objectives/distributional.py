"""This module projects the targets of critics that predict a distribution of returns, and compares them."""

import torch
from jaxtyping import Float
from torch import Tensor


def project_distribution(
    probs: Float[Tensor, "*batch A"],
    reward: Float[Tensor, "#*batch 1"],
    discount: Float[Tensor, "#*batch 1"],
    support_A: Float[Tensor, " A"],
) -> Float[Tensor, "*batch A"]:
    """Return the distribution of `reward + discount * z` on the atoms, for `z` distributed as `probs`.

    The mass of each moved atom goes to the two atoms that it falls between, in proportion to how near they are; beyond
    the ends it goes to the last atom (algorithm 1 of Bellemare et al., arXiv 1707.06887). `support_A` has the values of
    the atoms, evenly spaced, rising. On CUDA the sums have one order, and so the same bits each time.
    """
    if probs.is_cuda:
        # Not above: Triton comes with torch for CUDA only.
        from ksim_rl.objectives.projection_kernel import project_by_kernel

        return project_by_kernel(probs, reward, discount, support_A)
    low, high, count = support_A[0], support_A[-1], support_A.shape[0]
    spacing = (high - low) / (count - 1)
    position = ((reward + discount * support_A).clamp(low, high) - low) / spacing
    # The last atom itself counts as the upper neighbour of the one before, so that no index runs over the end.
    lower = position.floor().clamp(0, count - 2)
    upper_share = position - lower
    lower_index = lower.to(torch.int64).expand_as(probs)
    projected = torch.zeros_like(probs)
    projected.scatter_add_(-1, lower_index, probs * (1.0 - upper_share))
    projected.scatter_add_(-1, lower_index + 1, probs * upper_share)
    return projected


def mean_of(probs: Float[Tensor, "*batch A"], support_A: Float[Tensor, " A"]) -> Float[Tensor, "*batch"]:
    """Return the means of distributions."""
    # No product of matrices: autocast would round it to bfloat16.
    return (probs * support_A).sum(-1)


def cross_entropy(
    logits: Float[Tensor, "*batch A"], probs: Float[Tensor, "*batch A"]
) -> Float[Tensor, "*batch"]:
    """Return -sum(probs * log softmax(logits)), in nats."""
    return -(probs * logits.log_softmax(-1)).sum(-1)
