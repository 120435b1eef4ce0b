"""Observation normalization by the mean and variance of all observations so far."""

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from ksim_rl.checks import check_in_range


class ObservationNormalizer(nn.Module):
    """Shifts and scales observations by running statistics: `(x - mean) / sqrt(var + eps)`.

    `forward` never updates; `update` is called once per env state, after the policy update that used the old
    statistics, so that stored and recomputed action log-probabilities refer to the same policy. Statistics
    are exact: batches are merged as in Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm
    for computing sample variances" (1979), in float64, and equal the two-pass mean and variance of everything
    seen. Both methods are free of host syncs and keep every address, so they can be captured in a CUDA graph.

    Attributes:
        mean, var: float32 [L]; what `forward` uses. `var` is the population variance, 1 before the first
            update.
        count: int64 []; observations counted so far.

    Args:
        dim: L, size of the last dim of observations.
        eps: added to the variance. The default bounds the standard deviation below by 0.01: a constant
            component stays small when it starts to move.
        until: stop updating once so many observations are counted; None never stops.
    """

    mean: Tensor
    var: Tensor
    count: Tensor
    exact_mean: Tensor
    exact_sum_of_squares: Tensor

    def __init__(
        self,
        dim: int,
        *,
        eps: float = 1e-4,
        until: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        check_in_range("eps", eps, low=0.0, low_open=True)
        if until is not None:
            check_in_range("until", until, low=1)
        self.dim = dim
        self.eps = eps
        self.until = until
        self.register_buffer("mean", torch.zeros(dim, device=device))
        self.register_buffer("var", torch.ones(dim, device=device))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64, device=device))
        # Of squared deviations from the mean. float32 would stop growing after some 10^7 env states.
        self.register_buffer("exact_mean", torch.zeros(dim, dtype=torch.float64, device=device))
        self.register_buffer("exact_sum_of_squares", torch.zeros(dim, dtype=torch.float64, device=device))

    def forward(self, obs: Tensor) -> Tensor:
        """Normalize `obs` [..., L]."""
        return (obs - self.mean) * torch.rsqrt(self.var + self.eps)

    @torch.no_grad()
    def update(self, obs: Tensor, valid: Tensor | None = None) -> None:
        """Count every row of `obs` once.

        Rows with a non-finite element, and rows that `valid` marks False, are left out.

        Args:
            obs: [..., L].
            valid: bool, [...] or [..., 1].

        Raises:
            ValueError: if the last dim is not L, or `valid` does not have one element per row.
        """
        if obs.shape[-1] != self.dim:
            raise ValueError(f"obs has shape {tuple(obs.shape)}: the last dim must be {self.dim}")
        valid_1 = obs.isfinite().all(-1, keepdim=True)
        if valid is not None:
            if valid.numel() != valid_1.numel():
                raise ValueError(
                    f"valid has shape {tuple(valid.shape)}: expected one element per row of obs, "
                    f"whose shape is {tuple(obs.shape)}"
                )
            valid_1 = valid_1 & valid.reshape(valid_1.shape)
        if self.until is not None:
            valid_1 = valid_1 & (self.count < self.until)

        batch_dims = tuple(range(obs.ndim - 1))
        exact = obs.to(torch.float64)
        zero = torch.zeros((), dtype=torch.float64, device=obs.device)
        added = valid_1.sum()
        mean = torch.where(valid_1, exact, zero).sum(batch_dims) / added.clamp_min(1)
        sum_of_squares = torch.where(valid_1, exact - mean, zero).square().sum(batch_dims)
        self._merge(added, mean, sum_of_squares)

    def _merge(self, added: Tensor, mean: Tensor, sum_of_squares: Tensor) -> None:
        total = self.count + added
        share = added.to(torch.float64) / total.clamp_min(1)
        delta = mean - self.exact_mean
        self.exact_sum_of_squares.add_(sum_of_squares + delta.square() * share * self.count)
        self.exact_mean.add_(delta * share)
        self.mean.copy_(self.exact_mean)
        var = self.exact_sum_of_squares / total.clamp_min(1)
        self.var.copy_(torch.where(total > 0, var, torch.ones_like(var)))
        self.count.copy_(total)

    def extra_repr(self) -> str:
        """Describe the module in its repr."""
        return f"dim={self.dim}, eps={self.eps}, until={self.until}"


def update_normalizers(tensordict: TensorDictBase, *networks: nn.Module, valid: Tensor | None = None) -> None:
    """Update each normalizer inside `networks` with the observations that its network reads.

    Call it once per dataset: a normalizer that two networks share, or that is listed twice, is updated once.

    Args:
        tensordict: the env states, e.g. a rollout `["E","T"]`.
        networks: actors, critics; any other `nn.Module` is searched for networks that own a `normalizer`.
        valid: bool, one element per env state; those marked False are left out.
    """
    seen: set[int] = set()
    for network in networks:
        for module in network.modules():
            normalizer = getattr(getattr(module, "module", None), "normalizer", None)
            if not isinstance(module, TensorDictModule) or not isinstance(normalizer, ObservationNormalizer):
                continue
            if id(normalizer) not in seen:
                seen.add(id(normalizer))
                normalizer.update(tensordict.get(module.in_keys[0]), valid)
