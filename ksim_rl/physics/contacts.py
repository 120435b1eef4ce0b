"""This module mends the contacts that MuJoCo Warp finds otherwise than the C engine; docs/upstream.md shows each."""

import dataclasses
from collections.abc import Callable

import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import kernels, upstream
from ksim_rl.physics.collision.box_distances import take_over_measured_boxes
from ksim_rl.physics.height_field.contacts import take_over_height_fields

Hook = Callable[[mjw.Model, mjw.Data], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mending:
    """What a collision pass calls at its end.

    Attributes:
        added: append contacts that MuJoCo Warp does not find.
        corrected: change what MuJoCo Warp has written; where it has written nothing, they need not be called.
    """

    added: tuple[Hook, ...]
    corrected: tuple[Hook, ...]

    def __call__(self, warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        """Launch both, the added ones first."""
        for hook in (*self.added, *self.corrected):
            hook(warp_model, warp_data_E)


def follow_the_c_engine(warp_model: mjw.Model) -> None:
    """Mend contacts of height fields, boxes, steep capsules and geoms of priority, and distances of boxes.

    It changes the model in place: call it before anything copies it.
    """
    upstream.collide_boxes_exactly(warp_model)
    upstream.measure_without_contacts(warp_model)
    # The next one takes pairs away.
    corrected = [hook for hook, is_needed in CORRECTIONS.items() if is_needed(warp_model)]
    added = [take_over(warp_model) for take_over in (take_over_height_fields, take_over_measured_boxes)]
    mending = Mending(added=tuple(hook for hook in added if hook), corrected=tuple(corrected))
    if mending.added or mending.corrected:
        # MuJoCo Warp calls it after its own collision pass.
        warp_model.callback.contactfilter = mending


def align_steep_capsules(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch what turns the contacts of steep capsules with planes, which our own narrow phase need not."""
    contact = warp_data_E.contact
    inputs = [warp_model.geom_type, warp_data_E.geom_xmat, contact.geom, contact.worldid, warp_data_E.nacon]
    wp.launch(kernels.align_steep_capsules, dim=warp_data_E.naconmax, inputs=inputs, outputs=[contact.frame])


def _has_capsules_on_planes(warp_model: mjw.Model) -> bool:
    types = warp_model.geom_type.numpy()[upstream.geom_pairs(warp_model)[0]]
    return bool((np.sort(types) == (kernels.PLANE, kernels.CAPSULE)).all(-1).any())


def take_the_law_of_priority(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch what gives contacts the `solref` of the geom with priority, which our own narrow phase does itself."""
    m, contact = warp_model, warp_data_E.contact
    inputs = [m.geom_priority, m.geom_solref, m.pair_geom1, m.pair_geom2]
    inputs += [contact.geom, contact.worldid, warp_data_E.nacon]
    dim = warp_data_E.naconmax
    wp.launch(kernels.take_the_law_of_priority, dim=dim, inputs=inputs, outputs=[contact.solref])


def _has_direct_laws_of_priority(warp_model: mjw.Model) -> bool:
    """Return whether geoms of different priority may touch, one of which gives stiffness and damping directly."""
    pairs, pair_ids = upstream.geom_pairs(warp_model)
    pairs = pairs[pair_ids[:, 0] == upstream.NO_PAIR]
    differs = np.diff(warp_model.geom_priority.numpy()[pairs])[:, 0] != 0
    # Each world may draw a law of its own at any time.
    is_direct = (warp_model.geom_solref.numpy()[:, :, 0] <= 0.0).any(0) | (
        warp_model.geom_solref.shape[0] > 1
    )
    return bool((differs & is_direct[pairs].any(-1)).any())


CORRECTIONS: dict[Hook, Callable[[mjw.Model], bool]] = {
    align_steep_capsules: _has_capsules_on_planes,
    take_the_law_of_priority: _has_direct_laws_of_priority,
}
