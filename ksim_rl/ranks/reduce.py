"""Takes sums and means over all ranks, of many tensors in one collective, without a host sync.

Each rank sees the same bits. With one rank nothing is copied or computed. NCCL's collectives are captured in CUDA
graphs like any other kernel.
"""

from collections.abc import Mapping, Sequence

import torch
import torch.distributed as dist
from jaxtyping import Bool, Float, Num, Shaped
from torch import Tensor

from ksim_rl.device.group import size


def sum_(tensor: Num[Tensor, "*shape"]) -> None:
    """Replace a contiguous tensor by its sum over the ranks, in place."""
    if size() > 1:
        dist.all_reduce(tensor)


@torch.no_grad()
def mean_(tensors: Sequence[Float[Tensor, "*?shape"]], *, weight: Float[Tensor, ""]) -> None:
    """Replace each tensor by its mean over the ranks, in place, weighted by each rank's `weight`, in [0, 1].

    If the weight is the share of a rank's rows that take part, means over the rows of a rank become means over the
    rows of all ranks; 0 where no rank has any. One collective for all tensors, in the widest of their dtypes.
    """
    if size() == 1:
        return
    # The weight travels as the last element, so that one collective does for all.
    share = weight / size()
    flat = torch.cat([*(tensor.reshape(-1) for tensor in tensors), share.reshape(1)])
    means = flat[:-1]
    total = flat[-1]
    means.mul_(share)  # before they are added, so that sums of large gradients stay finite
    dist.all_reduce(flat)
    means.div_(total.clamp_min(torch.finfo(flat.dtype).tiny))
    # Back into the tensors, in place and by one kernel.
    pieces = means.split([tensor.numel() for tensor in tensors])
    views = [piece.view_as(tensor) for piece, tensor in zip(pieces, tensors, strict=True)]
    torch._foreach_copy_(list(tensors), views)


def gather(tensor: Shaped[Tensor, "*shape"]) -> list[Shaped[Tensor, "*shape"]]:
    """Return the tensors of all ranks, which have the same shape, in their order."""
    if size() == 1:
        return [tensor]
    parts = [torch.empty_like(tensor) for _ in range(size())]
    # In the order of ranks, so that all ranks add in one order and get the same bits.
    dist.all_gather(parts, tensor.contiguous())
    return parts


def merged(
    count: Num[Tensor, "*shape"], mean: Num[Tensor, "*shape"], squares: Num[Tensor, "*shape"]
) -> tuple[Num[Tensor, "*shape"], Num[Tensor, "*shape"], Num[Tensor, "*shape"]]:
    """Return count, mean and sum of squared deviations over all ranks, in float64, by one collective.

    With one rank they are returned as they are.
    """
    if size() == 1:
        return count, mean, squares
    # [3, ...] of this rank, then [R, ...] of each for all ranks.
    own_3 = torch.stack([column.to(torch.float64) for column in (count, mean, squares)])
    count_R, mean_R, squares_R = torch.stack(gather(own_3), 1)
    total = count_R.sum(0)
    # Counts of 0 must not divide by 0; their mean is 0.
    mean = (count_R * mean_R).sum(0) / total.clamp_min(1)
    return total, mean, (squares_R + count_R * (mean_R - mean).square()).sum(0)


def any_of(mask: Bool[Tensor, "*rows"]) -> Bool[Tensor, ""]:
    """Return whether any row of any rank is marked, on the device."""
    if size() == 1:
        return mask.any()
    count = mask.sum()
    sum_(count)
    return count > 0


def most_of(numbers: Num[Tensor, "*shape"]) -> Num[Tensor, "*shape"]:
    """Return the largest of all ranks' numbers, for each place."""
    if size() == 1:
        return numbers
    return torch.stack(gather(numbers)).amax(0)


def combined(
    metrics: Mapping[str, Num[Tensor, ""]], *, added: tuple[str, ...], most: tuple[str, ...]
) -> dict[str, Num[Tensor, ""]]:
    """Return metrics of all ranks, by one collective: sums of `added`, maxima of `most` (prefixes), and else means."""
    # In the order of the mapping, which is the same on all ranks.
    values_M = torch.stack(
        [value.detach().to(torch.float64).reshape(()) for value in metrics.values()]
    )
    values_RM = torch.stack(gather(values_M))
    whole = {}
    for name, column_R in zip(metrics, values_RM.unbind(1), strict=True):
        if name.startswith(most):
            largest_or_mean = column_R.amax()
        else:
            largest_or_mean = column_R.mean()
        whole[name] = column_R.sum() if name.startswith(added) else largest_or_mean
    return whole
