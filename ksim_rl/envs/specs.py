"""The specs of an env: shapes, dtypes and dim names of what it takes and gives, `["E"]`."""

from collections.abc import Mapping

import torch
from jaxtyping import Shaped
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded

from ksim_rl import dims


def observation(
    readings: Mapping[str, Mapping[str, Shaped[Tensor, " E *?leaf"]]],
    batch_size: torch.Size,
    device: torch.device | None,
) -> Composite:
    """Return the spec of the readings by group and name, [E, ...] each; empty groups are left out."""
    groups = {
        group: Composite(
            {
                name: Unbounded(shape=value.shape, dtype=value.dtype, device=device)
                for name, value in values.items()
            },
            shape=batch_size,
            device=device,
        )
        for group, values in readings.items()
        if values
    }
    return _named(groups, batch_size, device)


def action(size: int, batch_size: torch.Size, device: torch.device | None) -> Composite:
    """Return the spec of the action, float32 [E, size]."""
    return _named({"action": Unbounded(shape=_leaf(batch_size, size), device=device)}, batch_size, device)


def reward(batch_size: torch.Size, device: torch.device | None) -> Composite:
    """Return the spec of the reward, float32 [E, 1]."""
    return _named({"reward": Unbounded(shape=_leaf(batch_size, 1), device=device)}, batch_size, device)


def done(batch_size: torch.Size, device: torch.device | None) -> Composite:
    """Return the spec of `done`, `terminated` and `truncated`, bool [E, 1] each."""
    flags = {
        name: Binary(n=1, shape=_leaf(batch_size, 1), dtype=torch.bool, device=device)
        for name in ("done", "terminated", "truncated")
    }
    return _named(flags, batch_size, device)


def _leaf(batch_size: torch.Size, size: int) -> torch.Size:
    return torch.Size((*batch_size, size))


def _named(leaves: Mapping[str, object], batch_size: torch.Size, device: torch.device | None) -> Composite:
    spec = Composite(dict(leaves), shape=batch_size, device=device)
    spec.names = [dims.E]
    return spec
