"""This module mends the contacts that MuJoCo Warp finds otherwise than the C engine; docs/upstream.md shows each."""

from collections.abc import Callable

import mujoco_warp as mjw
import numpy as np

from ksim_rl.physics import native, upstream
from ksim_rl.physics.height_field.contacts import take_over_height_fields


def follow_the_c_engine(warp_model: mjw.Model) -> None:
    """Mend contacts of height fields, of boxes with boxes and of steep capsules with planes, in place.

    Call it before anything copies the model.
    """
    upstream.collide_boxes_exactly(warp_model)
    hooks: list[Callable[[mjw.Model, mjw.Data], None]] = []
    if height_fields := take_over_height_fields(warp_model):
        hooks.append(height_fields)
    types = warp_model.geom_type.numpy()[upstream.geom_pairs(warp_model)[0]]
    if (np.sort(types) == (mjw.GeomType.PLANE, mjw.GeomType.CAPSULE)).all(-1).any():
        hooks.append(align_steep_capsules)
    if hooks:
        # MuJoCo Warp calls it after its own collision pass.
        warp_model.callback.contactfilter = (
            hooks[0] if len(hooks) == 1 else lambda m, d: [f(m, d) for f in hooks]
        )


def align_steep_capsules(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch what turns the contacts of steep capsules with planes, which our own narrow phase need not."""
    source, threads = (
        native.source_of("collision", ("steep_capsules",)),
        32 if warp_data_E.qpos.device.is_cuda else 1,
    )
    native.launcher(
        source, upstream.GEOM_TYPES, {}, warp_model, warp_data_E, lanes=threads, threads=threads
    )()
