"""This module has what critics learn towards: copies that follow slowly, and returns distributed over atoms."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ksim_rl.device.running_moments import RunningMoments

Network = TypeVar("Network", bound=nn.Module)


def make_target(network: Network) -> Network:
    """Return a copy of a network that takes no gradients.

    Running statistics are shared, not copied: both networks see observations on the same scale at any time.
    """
    shared = {id(module): module for module in network.modules() if isinstance(module, RunningMoments)}
    return copy.deepcopy(network, memo=dict(shared)).requires_grad_(False)


@torch.no_grad()
def follow_(target: nn.Module, network: nn.Module, tau: float) -> None:
    """Move the weights of `target` by a share `tau` towards those of `network`, in a few kernels."""
    torch._foreach_lerp_(list(target.parameters()), list(network.parameters()), tau)


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
