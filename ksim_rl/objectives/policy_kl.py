"""Computes how far a policy moved, for any distribution: exactly where there is a closed form."""

from functools import reduce
from operator import add
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import CompositeDistribution, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, distributions
from torch.distributions import Distribution, TransformedDistribution
from torchrl.modules.distributions.utils import has_analytic_kl

from ksim_rl.transforms.specs import path_of


def kl_divergence(
    loc_old: Float[Tensor, "*batch L"],
    scale_old: Float[Tensor, "*batch L"],
    loc: Float[Tensor, "*batch L"],
    scale: Float[Tensor, "*batch L"],
) -> Float[Tensor, "*batch"]:
    """Return KL(old || new) of two diagonal gaussians in nats, from means and standard deviations."""
    # Written with the logarithm of the ratio, which is needed twice and exact where the two are equal.
    log_ratio = (scale_old / scale).log()
    error = ((loc_old - loc) / scale).square()
    return (0.5 * ((2.0 * log_ratio).exp() + error - 1.0) - log_ratio).sum(-1)


def gaussian_parameters(
    dist: Distribution,
) -> tuple[Float[Tensor, "*batch L"], Float[Tensor, "*batch L"]] | None:
    """Return `loc` and `scale` of a distribution built on a gaussian, else None.

    Two that squash their samples in the same way have the same divergence as the gaussians beneath them.
    """
    # Transformed distributions keep the gaussian inside, as `base_dist`.
    if hasattr(dist, "loc"):
        base = dist
    else:
        base = getattr(dist, "base_dist", dist)
    loc = getattr(base, "loc", None)
    scale = getattr(base, "scale", None)
    if isinstance(loc, Tensor) and isinstance(scale, Tensor):
        return loc, scale
    return None


def distribution_keys(actor: Any) -> list[NestedKey]:
    """Return the leaves from which a `ProbabilisticTensorDictSequential` builds its distribution, e.g. `loc`.

    Other policies, which only have a `get_dist`, name none.
    """
    roots = {path_of(key) for key in getattr(actor, "dist_params_keys", ())}
    if not roots:
        return []
    written = {path_of(key): key for key in actor.out_keys}
    # Mixed actions write a nested entry, whose leaves are wanted and not the node above them.
    parents = {path[:depth] for path in written for depth in range(1, len(path))}
    return [
        key
        for path, key in written.items()
        if path not in parents and any(path[: len(root)] == root for root in roots)
    ]


def observation_keys(actor: TensorDictModuleBase) -> list[NestedKey]:
    """Return the leaves of an EnvState that a policy reads: its `in_keys` without the parameters that it writes."""
    written = getattr(actor, "dist_params_keys", ())
    return [key for key in actor.in_keys if key not in written]


def stored_distribution(actor: Any, tensordict: TensorDictBase) -> Distribution | None:
    """Return the distribution whose parameters the data has, or None where it lacks one."""
    keys = distribution_keys(actor)
    if not keys or any(tensordict.get(key, None) is None for key in keys):
        return None
    return actor.build_dist_from_params(tensordict)


def policy_kl(old: Distribution, new: Distribution) -> Float[Tensor, "*batch"] | None:
    """Return KL(old || new) in nats with the batch shape of the two, or None where no closed form is known."""
    if isinstance(old, CompositeDistribution) and isinstance(new, CompositeDistribution):
        parts = [policy_kl(part, new.dists[key]) for key, part in old.dists.items()]
        # Parts may keep dims of their action, over which independent components add up.
        dims = len(old.batch_shape)
        known = [
            part.flatten(dims).sum(-1) if part.ndim > dims else part
            for part in parts
            if part is not None
        ]
        # One part without a closed form makes the sum unknown.
        if len(known) == len(parts):
            return reduce(add, known)
        return None
    if isinstance(old, TransformedDistribution):
        # torch compares the two maps on the host. Both are of one policy, and so the same.
        parameters = gaussian_parameters(old), gaussian_parameters(new)
        if parameters[0] is None or parameters[1] is None:
            return None
        return kl_divergence(*parameters[0], *parameters[1])
    if has_analytic_kl(old, new):
        return distributions.kl_divergence(old, new)
    return None


def estimated_kl(log_ratio: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return an unbiased estimate of KL(old || new) that is never negative, from actions of the old policy.

    It is r - 1 - log r with r = new / old, from log r (Schulman, "Approximating KL divergence", 2020).
    """
    return torch.expm1(log_ratio) - log_ratio
