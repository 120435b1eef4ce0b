"""This module makes target networks: copies that follow slowly."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import nn

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
