"""This module mends the contacts that MuJoCo Warp finds otherwise than the C engine; docs/upstream.md shows each."""

from collections.abc import Callable

import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import kernels, upstream
from ksim_rl.physics.collision.box_distances import take_over_measured_boxes
from ksim_rl.physics.height_field.contacts import take_over_height_fields


def follow_the_c_engine(warp_model: mjw.Model) -> None:
    """Mend contacts of height fields, of boxes with boxes and of steep capsules with planes, and distances of boxes.

    It changes the model in place: call it before anything copies it.
    """
    upstream.collide_boxes_exactly(warp_model)
    upstream.measure_without_contacts(warp_model)
    hooks: list[Callable[[mjw.Model, mjw.Data], None]] = []
    if height_fields := take_over_height_fields(warp_model):
        hooks.append(height_fields)
    types = warp_model.geom_type.numpy()[upstream.geom_pairs(warp_model)[0]]
    if (np.sort(types) == (kernels.PLANE, kernels.CAPSULE)).all(-1).any():
        hooks.append(align_steep_capsules)
    if distances := take_over_measured_boxes(warp_model):
        hooks.append(distances)
    if hooks:
        # MuJoCo Warp calls it after its own collision pass.
        every = hooks[0] if len(hooks) == 1 else lambda m, d: [hook(m, d) for hook in hooks]
        warp_model.callback.contactfilter = every


def align_steep_capsules(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch what turns the contacts of steep capsules with planes, which our own narrow phase need not."""
    contact = warp_data_E.contact
    inputs = [warp_model.geom_type, warp_data_E.geom_xmat, contact.geom, contact.worldid, warp_data_E.nacon]
    wp.launch(kernels.align_steep_capsules, dim=warp_data_E.naconmax, inputs=inputs, outputs=[contact.frame])
