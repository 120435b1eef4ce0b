"""Keeps an exact running mean and variance, in one process or over all ranks."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ksim_rl.checks import check_in_range
from ksim_rl.device import group
from ksim_rl.device.quick_launch import address, as_operator, launch_of
from ksim_rl.ranks.reduce import merged

# Parts of a batch whose moments are taken side by side: at most so many, of at least so many rows. Short ones hold up
# little other work of a GPU. Then the moments of so many parts are merged, and at last of all these groups.
MOST_PARTS = 2048
LEAST_ROWS = 16
GROUP = 32
_quick = launch_of("ksim_rl/ranks/moments.cuh", {"GROUP": GROUP})


def _count(
    values_NL: Tensor,
    valid_N: Tensor | None,
    count: Tensor,
    mean_L: Tensor,
    squares_L: Tensor,
    until: int,
) -> None:
    """Count rows into moments, in place: all numbers are added in one order, in float64."""
    num_rows, dim = values_NL.shape
    # Rows of a part, parts, and groups of parts, each rounded up.
    rows = max(LEAST_ROWS, -(-num_rows // MOST_PARTS))
    parts = -(-num_rows // rows)
    groups = -(-parts // GROUP)
    span = dim if count.device.type == "cpu" else 1  # of a row, for a thread that looks for faults
    # Stage 0 sets the rows to 0 that do not count.
    counts_N = torch.ones(num_rows, dtype=torch.uint8, device=count.device)
    # Mean and squares of each column, and one weight, for each part and group; the total at the end.
    moments = torch.empty(
        (2 * dim + 1) * (parts + groups) + 1, dtype=torch.float64, device=count.device
    )
    at = [address(own) for own in (values_NL, valid_N, counts_N, moments, count, mean_L, squares_L)]
    sizes = ((num_rows, dim // span), (parts, dim), (groups, dim), (1, dim))
    for stage, size in enumerate(sizes):
        _quick(
            count.device,
            size,
            stage,
            num_rows,
            dim,
            rows,
            parts,
            groups,
            group.size(),
            span,
            until,
            *at,
        )
    count.copy_(moments[-1])


def _count_in_torch(
    values_NL: Tensor,
    valid_N: Tensor | None,
    count: Tensor,
    mean_L: Tensor,
    squares_L: Tensor,
    until: int,
) -> None:
    """Do the same as the kernel: the moments of the batch by two passes, merged with all earlier ones."""
    # A row counts as a whole or not at all.
    counted_N = values_NL.isfinite().all(1)
    if valid_N is not None:
        counted_N &= valid_N.bool()
    # The limit is for all ranks together, which have counted about the same.
    if until >= 0:
        counted_N &= count * group.size() < until
    weight = counted_N.sum().double()
    own_NL = torch.where(counted_N[:, None], values_NL.double(), 0.0)
    own_mean_L = own_NL.sum(0) / weight.clamp_min(1.0)
    error_NL = torch.where(counted_N[:, None], own_NL - own_mean_L, 0.0)
    total = count + weight
    share = weight / total.clamp_min(1.0)
    # The update of Chan, Golub and LeVeque for two sets of rows.
    delta_L = own_mean_L - mean_L
    squares_L += error_NL.square().sum(0) + delta_L.square() * share * count
    mean_L += delta_L * share
    count.copy_(total)


_count_rows = as_operator(
    "count_rows",
    _count,
    lambda *_: None,
    mutates=("count", "mean_L", "squares_L"),
    in_torch=_count_in_torch,
)


class RunningMoments(nn.Module):
    """Mean and population variance of all rows counted so far.

    Batches are merged as in Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm for computing sample
    variances" (1979), in float64, and equal the two-pass mean and variance of everything seen. They are added in one
    order. No method makes the host wait or moves a buffer, so all can be captured in a CUDA graph.

    With several ranks, each keeps the moments of its own rows, and `publish` merges the moments of all into `mean` and
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
        self.register_buffer(
            "exact_sum_of_squares", torch.zeros(dim, dtype=torch.float64, device=device)
        )

    def normalized(
        self, values: Float[Tensor, "*batch L"], eps: float
    ) -> Float[Tensor, "*batch L"]:
        """Return `(values - mean) / sqrt(var + eps)`."""
        return (values - self.mean).mul_(torch.rsqrt(self.var + eps))

    @torch.no_grad()
    def update(
        self, values: Float[Tensor, "*batch L"], valid: Bool[Tensor, "*rows"] | None = None
    ) -> None:
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
            raise ValueError(
                f"obs has shape {tuple(values.shape)}: the last dim must be {self.dim}"
            )
        values_NL = values.reshape(-1, self.dim)
        if valid is not None and valid.numel() != len(values_NL):
            raise ValueError(
                f"valid has shape {tuple(valid.shape)}: expected one element per row of obs, "
                f"whose shape is {tuple(values.shape)}"
            )
        if valid is None:
            valid_N = None
        else:
            valid_N = valid.reshape(-1).contiguous()
        # -1 stands for no limit, as kernels take numbers only.
        until = -1 if self.until is None else self.until
        exact = self.count, self.exact_mean, self.exact_sum_of_squares
        if len(values_NL):
            _count_rows(values_NL.to(torch.float32).contiguous(), valid_N, *exact, until)

    @torch.no_grad()
    def count_again(self, other: "RunningMoments") -> None:
        """Count the rows that another one has counted, without reading them; `mean` and `var` stay as they are.

        As with rows, nothing is counted from `until` on.
        """
        weight = other.count.double()
        if self.until is not None:
            weight = torch.where(self.count * group.size() < self.until, weight, 0.0)
        total = self.count + weight
        share = weight / total.clamp_min(1.0)
        delta_L = other.exact_mean - self.exact_mean
        # As in `_count_in_torch`.
        between_L = delta_L.square() * share * self.count
        added_L = torch.where(weight > 0.0, other.exact_sum_of_squares, 0.0)
        self.exact_sum_of_squares += added_L + between_L
        self.exact_mean += delta_L * share
        self.count.copy_(total)


@torch.no_grad()
def publish(every: Sequence[RunningMoments]) -> None:
    """Set `mean` and `var` of each from all that was counted; all ranks have to call it, for one collective."""
    if not every:
        return
    # All columns side by side, so that one collective serves all of them.
    dims = [own.dim for own in every]
    own_L = [(own.count.expand(own.dim), own.exact_mean, own.exact_sum_of_squares) for own in every]
    count_L, mean_L, squares_L = merged(*map(torch.cat, zip(*own_L, strict=True)))
    # Before the first row the variance is 1, so that values pass unscaled.
    var_L = torch.where(count_L > 0, squares_L / count_L.clamp_min(1), 1.0)
    torch._foreach_copy_([own.mean for own in every], mean_L.split(dims))
    torch._foreach_copy_([own.var for own in every], var_L.split(dims))
