"""This module normalizes observations by the mean and variance of all observations so far."""

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from ksim_rl.checks import check_in_range
from ksim_rl.device.running_moments import RunningMoments
from ksim_rl.modules.observation_keys import side_by_side


class ObservationNormalizer(RunningMoments):
    """Shifts and scales observations by running statistics: `(x - mean) / sqrt(var + eps)`.

    `forward` never updates; `update` is called once per env state, after the policy update that used the old
    statistics, so that stored and recomputed action log-probabilities refer to the same policy. With several ranks all
    of them have to call it. Statistics are exact, and both methods can be captured in a CUDA graph: see
    `RunningMoments`.

    Args:
        dim: L, size of the last dim of observations.
        eps: added to the variance. The default bounds the standard deviation below by 0.01: a constant
            component stays small when it starts to move.
        until: stop updating once so many observations are counted; None never stops.
    """

    def __init__(
        self,
        dim: int,
        *,
        eps: float = 1e-4,
        until: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        check_in_range("eps", eps, low=0.0, low_open=True)
        super().__init__(dim, until=until, device=device)
        self.eps = eps

    def forward(self, obs: Float[Tensor, "*batch L"]) -> Float[Tensor, "*batch L"]:
        """Normalize observations."""
        return (obs - self.mean) * torch.rsqrt(self.var + self.eps)

    def extra_repr(self) -> str:
        """Describe the module in its repr."""
        return f"dim={self.dim}, eps={self.eps}, until={self.until}"


def update_normalizers(
    tensordict: TensorDictBase, *networks: nn.Module, valid: Bool[Tensor, "*batch"] | None = None
) -> None:
    """Update each normalizer inside `networks` with the observations that its network reads.

    Call it once per dataset: a normalizer that two networks share, or that is listed twice, is updated once.

    Args:
        tensordict: the env states, e.g. a rollout `["E","T"]`.
        networks: actors, critics; any other `nn.Module` is searched for networks that own a `normalizer`.
        valid: env states marked False are left out.
    """
    seen: set[int] = set()
    for network in networks:
        for module in network.modules():
            normalizer = getattr(getattr(module, "module", None), "normalizer", None)
            if not isinstance(module, TensorDictModule) or not isinstance(normalizer, ObservationNormalizer):
                continue
            if id(normalizer) not in seen:
                seen.add(id(normalizer))
                normalizer.update(_observation(tensordict, module, normalizer.dim), valid)


def _observation(tensordict: TensorDictBase, module: TensorDictModule, dim: int) -> Tensor:
    """Return what a network normalizes: its first inputs, as many as make up `dim` numbers."""
    observations: list[Tensor] = []
    for key in module.in_keys:
        if sum(obs.shape[-1] for obs in observations) < dim:
            observations.append(tensordict.get(key))
    return side_by_side(observations)
