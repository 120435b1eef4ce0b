"""Takes means over the env states whose mask is True."""

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from ksim_rl import ranks

# Where TorchRL's losses look for rows to leave out (`LossModule.loss_mask_key`), stock ones included.
MASK_KEY: NestedKey = ("collector", "mask")


def mask_of(env_states: TensorDictBase, like_B: Float[Tensor, "*batch"]) -> Bool[Tensor, "*batch"]:
    """Return the mask of env states in the shape of `like_B`; all take part where there is none."""
    mask = env_states.get(MASK_KEY, None)
    if mask is None:
        return torch.ones_like(like_B, dtype=torch.bool)
    return mask.reshape(like_B.shape)


def masked_mean(values: Float[Tensor, "*batch"], mask: Bool[Tensor, "*batch"]) -> Float[Tensor, ""]:
    """Return the mean of the values that `mask` marks; 0 where it marks none."""
    # A where instead of a product: values left out may be anything, and zero times infinity is NaN.
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp_min(1)


def standardized(
    values: Float[Tensor, "*batch"], mask: Bool[Tensor, "*batch"], *, lowest_std: float
) -> Float[Tensor, "*batch"]:
    """Shift and scale to mean 0 and standard deviation 1, or divide by `lowest_std`, over all that masks mark."""
    # Sums of this rank; the merge below makes them sums of all ranks.
    count = mask.sum()
    own_mean = masked_mean(values, mask)
    own_squares = torch.where(mask, values - own_mean, 0.0).square().sum()
    count, mean, squares = ranks.merged(count, own_mean, own_squares)
    # The unbiased estimate, as torch's `std`; with one value it is zero, and the bound takes over.
    std = (squares / (count - 1).clamp_min(1)).sqrt().clamp_min(lowest_std)
    return (values - mean.to(values.dtype)) / std.to(values.dtype)
