"""This module keeps gradients that are not finite from the optimizer."""

from collections.abc import Iterable

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn


class NonFiniteStepsError(RuntimeError):
    """Too many gradient steps in a row had a loss or a gradient that was not finite."""

    @classmethod
    def of(cls, in_a_row: int, *, limit: int, skipped: int) -> "NonFiniteStepsError":
        """Build the error for so many skipped steps in a row, and since the start."""
        return cls(
            f"{in_a_row} gradient steps in a row had a loss or gradient that is not finite (limit {limit}, "
            f"{skipped} since the start); the parameters are those of the last good step. "
            "Lower the learning rate or max_grad_norm, or look for extreme rewards and observations"
        )


class StepGuard(nn.Module):
    """Counts skipped gradient steps on the device.

    Attributes:
        skipped: int64 [], gradient steps skipped since the start.
        skipped_in_a_row: int64 [], gradient steps skipped since the last one that was made.
    """

    skipped: Tensor
    skipped_in_a_row: Tensor

    def __init__(self, *, device: torch.device | str | None = None) -> None:
        super().__init__()
        self.register_buffer("skipped", torch.zeros((), dtype=torch.int64, device=device))
        self.register_buffer("skipped_in_a_row", torch.zeros((), dtype=torch.int64, device=device))

    @torch.no_grad()
    def count_(self, found_inf: Float32[Tensor, ""]) -> None:
        """Count one gradient step; `found_inf` is 1 if it was skipped, else 0. Makes no host sync."""
        skipped = found_inf.to(torch.int64)
        self.skipped.add_(skipped)
        self.skipped_in_a_row.add_(skipped).mul_(skipped)

    def check(self, limit: int) -> None:
        """Read the counter on the host (once per iteration, not per step) and stop a run that cannot go on.

        Raises:
            NonFiniteStepsError: if the last `limit` steps or more were skipped.
        """
        in_a_row = int(self.skipped_in_a_row)
        if in_a_row >= limit:
            raise NonFiniteStepsError.of(in_a_row, limit=limit, skipped=int(self.skipped))


@torch.no_grad()
def clip_and_guard(
    parameters: Iterable[nn.Parameter],
    max_grad_norm: float | None,
    *,
    loss: Float[Tensor, ""] | None = None,
) -> tuple[Float32[Tensor, ""], Float32[Tensor, ""]]:
    """Scale the gradients down to a total norm of at most `max_grad_norm`, in place, and tell if they are finite.

    As `torch.nn.utils.clip_grad_norm_`, without host syncs.

    Args:
        parameters: their `.grad` is clipped; those without one are left out.
        max_grad_norm: bound on the 2-norm over all gradients; None does not clip.
        loss: also tested for being finite.

    Returns:
        The norm before clipping, and `found_inf`: 1 if the norm or the loss is not
        finite, else 0. Set it as `optimizer.found_inf` of a fused optimizer, which then leaves parameters,
        moments and step count as they are.
    """
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    norm = nn.utils.get_total_norm(gradients)
    finite = norm.isfinite() if loss is None else norm.isfinite() & loss.isfinite()
    if max_grad_norm is not None:
        torch._foreach_mul_(gradients, (max_grad_norm / (norm + 1e-6)).clamp_max(1.0))
    return norm, 1.0 - finite.to(torch.float32)
