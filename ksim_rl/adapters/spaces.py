"""Turns the TorchRL spec of one leaf into the Gymnasium space of one row."""

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torchrl.data import Categorical, OneHot, TensorSpec, Unbounded
from torchrl.data.tensor_specs import ContinuousBox


def space_of(spec: TensorSpec, *, batch_dims: int = 1) -> spaces.Space:
    """Return the space of one row: a `Discrete` of choices, else a `Box`, which is infinite without bounds.

    Raises ValueError for kinds of choices that Gymnasium has no space for.
    """
    shape = tuple(spec.shape[batch_dims:])
    if isinstance(spec, OneHot | Categorical) and shape in ((), (spec.space.n,)):
        return spaces.Discrete(spec.space.n)
    dtype = torch.empty((), dtype=spec.dtype).numpy().dtype
    # TorchRL writes "unbounded" as the largest float, which Gymnasium would sample up to.
    if isinstance(spec, Unbounded) and spec.dtype.is_floating_point:
        return spaces.Box(-np.inf, np.inf, shape=shape, dtype=dtype.type)
    limits: Any = spec.space
    if not isinstance(limits, ContinuousBox):
        raise ValueError(
            f"{type(spec).__name__} of shape {shape}: adapters take boxes and single choices"
        )
    low, high = (
        bound.expand(spec.shape).reshape(-1, *shape)[0].cpu().numpy()
        for bound in (limits.low, limits.high)
    )
    return spaces.Box(low, high, dtype=dtype.type)


def finite(space: Any, limit: float) -> Any:
    """Return the space of actions with -limit and limit where a box has no bounds."""
    if not isinstance(space, spaces.Box):
        return space
    low = np.where(np.isfinite(space.low), space.low, -limit)
    high = np.where(np.isfinite(space.high), space.high, limit)
    return spaces.Box(low, high, dtype=np.float32)
