"""Distributions of returns on evenly spaced atoms (C51; Bellemare et al., arXiv 1707.06887)."""

import torch
from torch import Tensor


def project_distribution(probs: Tensor, reward: Tensor, discount: Tensor, support: Tensor) -> Tensor:
    """Return the distribution of `reward + discount * z` on the atoms, for `z` distributed as `probs`.

    The mass of each moved atom goes to the two atoms that it falls between, in proportion to how near they are; beyond
    the ends it goes to the last atom (algorithm 1 of the paper).

    Args:
        probs: [..., A], probabilities of the atoms.
        reward, discount: broadcastable with [..., 1].
        support: [A], values of the atoms, evenly spaced, rising.

    Returns:
        Probabilities [..., A].
    """
    low, high, count = support[0], support[-1], support.shape[0]
    spacing = (high - low) / (count - 1)
    position = ((reward + discount * support).clamp(low, high) - low) / spacing
    # The last atom itself counts as the upper neighbour of the one before, so that no index runs over the end.
    lower = position.floor().clamp(0, count - 2)
    upper_share = position - lower
    lower_index = lower.to(torch.int64).expand_as(probs)
    projected = torch.zeros_like(probs)
    projected.scatter_add_(-1, lower_index, probs * (1.0 - upper_share))
    projected.scatter_add_(-1, lower_index + 1, probs * upper_share)
    return projected


def mean_of(probs: Tensor, support: Tensor) -> Tensor:
    """Return the means [...] of distributions [..., A]."""
    # No product of matrices: autocast would round it to bfloat16.
    return (probs * support).sum(-1)


def cross_entropy(logits: Tensor, probs: Tensor) -> Tensor:
    """Return -sum(probs * log softmax(logits)), in nats, [...], for both [..., A]."""
    return -(probs * logits.log_softmax(-1)).sum(-1)
