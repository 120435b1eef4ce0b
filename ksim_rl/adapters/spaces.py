"""This module turns the TorchRL spec of one leaf into the Gymnasium space of one row."""

import numpy as np
from gymnasium import spaces
from torchrl.data import TensorSpec, Unbounded
from torchrl.data.tensor_specs import ContinuousBox


def box(spec: TensorSpec) -> spaces.Box:
    """Return the space of one row of a float32 spec [E, ...]; without bounds it is infinite."""
    shape = tuple(spec.shape[1:])
    # TorchRL writes "unbounded" as the largest float, which Gymnasium would sample up to.
    if isinstance(spec, Unbounded):
        return spaces.Box(-np.inf, np.inf, shape=shape, dtype=np.float32)
    limits = spec.space
    assert isinstance(limits, ContinuousBox)
    low, high = (bound[0].cpu().numpy().astype(np.float32) for bound in (limits.low, limits.high))
    return spaces.Box(low, high, dtype=np.float32)
