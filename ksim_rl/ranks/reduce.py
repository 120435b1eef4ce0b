"""Sums and means over all ranks are taken here, of many tensors in one collective, without a host sync.

Each rank sees the same bits. With one rank nothing is copied or computed. NCCL's collectives are captured in CUDA
graphs like any other kernel.
"""

from collections.abc import Mapping, Sequence

import torch
import torch.distributed as dist
from jaxtyping import Bool, Float, Num, Shaped
from torch import Tensor

from ksim_rl.ranks.group import size


def sum_(tensors: Sequence[Num[Tensor, "*?shape"]]) -> None:
    """Replace each tensor by its sum over the ranks, in place: one collective for each dtype."""
    _reduce_(tensors, None)


def mean_(tensors: Sequence[Float[Tensor, "*?shape"]], *, weight: Float[Tensor, ""]) -> None:
    """Replace each tensor by its mean over the ranks, in place, in which each rank has its `weight`, in [0, 1].

    With the share of its rows that take part for weight, means over a rank's become means over those of all ranks; 0
    where no rank has any. One collective for each dtype.
    """
    _reduce_(tensors, weight / size())


@torch.no_grad()
def _reduce_(tensors: Sequence[Tensor], share: Tensor | None) -> None:
    if size() == 1:
        return
    by_dtype: dict[torch.dtype, list[Tensor]] = {}
    for tensor in tensors:
        by_dtype.setdefault(tensor.dtype, []).append(tensor)
    for group in by_dtype.values():
        flat = torch.cat([*(tensor.reshape(-1) for tensor in group), group[0].new_ones(1)])
        if share is not None:  # before they are added, so that sums of large gradients stay finite
            flat.mul_(share)
        dist.all_reduce(flat)
        if share is not None:
            flat.div_(flat[-1].clamp_min(torch.finfo(flat.dtype).tiny))
        pieces = flat[:-1].split([tensor.numel() for tensor in group])
        torch._foreach_copy_(
            group, [piece.view_as(tensor) for piece, tensor in zip(pieces, group, strict=True)]
        )


def gather(tensor: Shaped[Tensor, "*shape"]) -> list[Shaped[Tensor, "*shape"]]:
    """Return the tensors of all ranks, which have the same shape, in their order."""
    if size() == 1:
        return [tensor]
    parts = [torch.empty_like(tensor) for _ in range(size())]
    dist.all_gather(parts, tensor.contiguous())
    return parts


def any_of(mask: Bool[Tensor, "*rows"]) -> Bool[Tensor, ""]:
    """Return whether any row of any rank is marked, on the device."""
    if size() == 1:
        return mask.any()
    count = mask.sum()
    sum_([count])
    return count > 0


def most_of(number: Num[Tensor, ""]) -> Num[Tensor, ""]:
    """Return the largest of all ranks' numbers."""
    return number if size() == 1 else torch.stack(gather(number)).amax()


def combined(
    metrics: Mapping[str, Num[Tensor, ""]], *, added: tuple[str, ...], most: tuple[str, ...]
) -> dict[str, Num[Tensor, ""]]:
    """Return metrics of all ranks, by one collective: sums, or maxima, of names that begin so, and means else."""
    values_M = torch.stack([value.detach().to(torch.float64).reshape(()) for value in metrics.values()])
    values_RM = torch.stack(gather(values_M))
    whole = {}
    for name, column_R in zip(metrics, values_RM.unbind(1), strict=True):
        largest_or_mean = column_R.amax() if name.startswith(most) else column_R.mean()
        whole[name] = column_R.sum() if name.startswith(added) else largest_or_mean
    return whole
