"""One world's model fields, written into a model of the C engine."""

from collections.abc import Mapping

import mujoco
import numpy as np

from ksim_rl.physics.fields import GRAVITY


def write_fields(model: mujoco.MjModel, fields: Mapping[str, np.ndarray]) -> None:
    """Write the fields of one world (as `World.per_world_fields` gives them, one row) into `model`, in place."""
    for name, value in fields.items():
        target = model.opt.gravity if name == GRAVITY else getattr(model, name, None)
        # A few of MuJoCo Warp's fields are its own, or laid out otherwise.
        if target is not None and target.size == value.size:
            target[:] = value.reshape(target.shape)
