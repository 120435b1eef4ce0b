"""This module finds the box of actions that a bounded policy can take."""

import torch
from jaxtyping import Float
from torch import Tensor
from torchrl.data import TensorSpec


def action_range(
    spec: TensorSpec, bound: float, *, device: torch.device | str | None = None
) -> tuple[Float[Tensor, " L"], Float[Tensor, " L"]]:
    """Return the lowest and highest action.

    Off-policy methods need bounded actions: their critics are asked about whatever the policy proposes, and there is no
    trust region that keeps it near what was tried. Where the spec is bounded these are its bounds; elsewhere (joint
    position offsets, say) they are -bound and bound, in the units of the action, before the action term's own scale.
    """
    low, high = (getattr(getattr(spec, "space", None), name, None) for name in ("low", "high"))
    shape = spec.shape[-1:]
    lowest = torch.full(shape, -bound, device=device)
    highest = torch.full(shape, bound, device=device)
    if not isinstance(low, Tensor) or not isinstance(high, Tensor):
        return lowest, highest
    # A spec has the batch dims of its env; all envs have the same bounds. Unbounded ones are huge or infinite.
    low, high = (edge.reshape(-1, *shape)[0].to(lowest) for edge in (low, high))
    bounded = (low > -1e6) & (high < 1e6)
    return torch.where(bounded, low, lowest), torch.where(bounded, high, highest)
