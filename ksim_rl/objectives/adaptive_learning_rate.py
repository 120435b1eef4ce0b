"""This module adapts the learning rate to how far the policy moves."""

import torch
from jaxtyping import Float, Float32
from torch import Tensor


@torch.no_grad()
def adapt_learning_rate_(
    lr: Float32[Tensor, ""],
    kl: Float[Tensor, ""],
    *,
    desired_kl: float,
    factor: float = 1.5,
    lr_min: float = 1e-5,
    lr_max: float = 1e-2,
) -> Float32[Tensor, ""]:
    """Divide `lr` by `factor` if `kl` exceeds twice the desired one, multiply it if below half, in place.

    The rule of rsl_rl, on the device: no host sync, so it can be captured in a CUDA graph. A divergence of
    exactly zero (the policy has not moved yet), or one that is NaN, changes nothing.

    Args:
        lr: the learning rate of the optimizer.
        kl: mean divergence in nats between the policy that collected the data and the present one.
        desired_kl: target, in nats.
        factor: step of the change, > 1.
        lr_min, lr_max: bounds.

    Returns:
        `lr`.
    """
    slower = (lr / factor).clamp_min(lr_min)
    faster = (lr * factor).clamp_max(lr_max)
    # Comparisons with NaN are False.
    too_far = kl > 2.0 * desired_kl
    too_near = (kl < 0.5 * desired_kl) & (kl > 0.0)
    return lr.copy_(torch.where(too_far, slower, torch.where(too_near, faster, lr)))
