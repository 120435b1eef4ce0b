"""This module keeps an exact running mean and variance, in one process or over all ranks."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ksim_rl import ranks
from ksim_rl.checks import check_in_range


class RunningMoments(nn.Module):
    """Mean and population variance of all rows counted so far.

    Batches are merged as in Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm for computing sample
    variances" (1979), in float64, and equal the two-pass mean and variance of everything seen. No method makes the
    host wait or moves a buffer, so all can be captured in a CUDA graph.

    With several ranks, each keeps the moments of its own rows, and `publish` merges those of all ranks into `mean` and
    `var`: bit-identical everywhere, and equal to one process that saw all the rows.

    `mean` and `var`, float32 [L], of all ranks, are 0 and 1 before the first `publish`; `count`, int64 [], is the rows
    counted so far on this rank, which stops counting at `until` by the number of ranks.
    """

    mean: Tensor
    var: Tensor
    count: Tensor
    exact_mean: Tensor
    exact_sum_of_squares: Tensor

    def __init__(
        self, dim: int, *, until: int | None = None, device: torch.device | str | int | None = None
    ) -> None:
        super().__init__()
        if until is not None:
            check_in_range("until", until, low=1)
        self.dim = dim
        self.until = until
        self.register_buffer("mean", torch.zeros(dim, device=device))
        self.register_buffer("var", torch.ones(dim, device=device))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64, device=device))
        # Of squared deviations from the mean. float32 would stop growing after some 10^7 rows.
        self.register_buffer("exact_mean", torch.zeros(dim, dtype=torch.float64, device=device))
        self.register_buffer("exact_sum_of_squares", torch.zeros(dim, dtype=torch.float64, device=device))

    def normalized(self, values: Float[Tensor, "*batch L"], eps: float) -> Float[Tensor, "*batch L"]:
        """Return `(values - mean) / sqrt(var + eps)`."""
        return (values - self.mean).mul_(torch.rsqrt(self.var + eps))

    @torch.no_grad()
    def update(self, values: Float[Tensor, "*batch L"], valid: Bool[Tensor, "*rows"] | None = None) -> None:
        """Count every row of `values` once, and publish.

        Rows with a non-finite element, and rows that `valid` ([...] or [..., 1]) marks False, are left out.
        """
        self.count_rows(values, valid)
        publish([self])

    @torch.no_grad()
    def count_rows(
        self, values: Float[Tensor, "*batch L"], valid: Bool[Tensor, "*rows"] | None = None
    ) -> None:
        """Count every row of `values` once, as `update` does, and leave `mean` and `var` as they are."""
        if values.shape[-1] != self.dim:
            raise ValueError(f"obs has shape {tuple(values.shape)}: the last dim must be {self.dim}")
        values_NL = values.reshape(-1, self.dim)
        # No matrix products here: the first one on a stream takes memory for good, and this runs beside other work.
        valid_N = values_NL.isfinite().all(-1)
        if valid is not None:
            if valid.numel() != valid_N.numel():
                raise ValueError(
                    f"valid has shape {tuple(valid.shape)}: expected one element per row of obs, "
                    f"whose shape is {tuple(values.shape)}"
                )
            valid_N = valid_N & valid.reshape(-1)
        if self.until is not None:
            valid_N = valid_N & (self.count < self.until / ranks.size())

        exact_NL = torch.where(valid_N[:, None], values_NL, 0.0).to(torch.float64)
        weight_N = valid_N.to(torch.float64)
        added = weight_N.sum()
        mean = exact_NL.sum(0) / added.clamp_min(1)
        sum_of_squares = exact_NL.sub_(mean).mul_(weight_N[:, None]).square_().sum(0)

        # The union of both, as of those of ranks in `ranks.merged`, in place.
        before = self.count.to(torch.float64)
        total = before + added
        share = added / total.clamp_min(1)
        delta = mean.sub_(self.exact_mean)
        self.exact_mean.addcmul_(delta, share)
        self.exact_sum_of_squares.add_(sum_of_squares.addcmul_(delta.square_(), share * before))
        self.count.copy_(total)


@torch.no_grad()
def publish(every: Sequence[RunningMoments]) -> None:
    """Set `mean` and `var` of each from all that was counted; all ranks have to call it, for one collective."""
    if not every:
        return
    dims = [own.dim for own in every]
    own_L = [(own.count.expand(own.dim), own.exact_mean, own.exact_sum_of_squares) for own in every]
    count_L, mean_L, squares_L = ranks.merged(*map(torch.cat, zip(*own_L, strict=True)))
    var_L = torch.where(count_L > 0, squares_L / count_L.clamp_min(1), 1.0)
    torch._foreach_copy_([own.mean for own in every], mean_L.split(dims))
    torch._foreach_copy_([own.var for own in every], var_L.split(dims))
