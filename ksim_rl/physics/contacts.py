"""Mends the contacts that MuJoCo Warp and the C engine find differently; docs/upstream.md shows each."""

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
    """The hooks that a collision pass calls at its end.

    Attributes:
        always: append contacts that MuJoCo Warp does not find, and change everyone's.
        of_theirs: change contacts that MuJoCo Warp's narrow phase has written, of the pairs that the model lists.
        at_last: change the contacts that the others have left.
    """

    always: tuple[Hook, ...]
    of_theirs: tuple[Hook, ...]
    at_last: tuple[Hook, ...]

    def __call__(self, warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        """Launch all of them."""
        for hook in self.hooks():
            hook(warp_model, warp_data_E)

    def hooks(self) -> tuple[Hook, ...]:
        """Return all of them, in their order."""
        return (*self.always, *self.of_theirs, *self.at_last)


def follow_the_c_engine(warp_model: mjw.Model) -> None:
    """Mend contacts of height fields, boxes, steep capsules and geoms of priority, and distances of boxes.

    It changes the model in place: call it before anything copies it.
    """
    # First, since the steps below read the lists of pairs that these change.
    upstream.collide_boxes_exactly(warp_model)
    upstream.take_pairs_as_written(warp_model)
    upstream.measure_without_contacts(warp_model)
    # The next one takes pairs away.
    ways = (take_over_height_fields, take_over_measured_boxes, rows_left_out)
    always = tuple(filter(None, [way(warp_model) for way in ways]))
    of_theirs = corrections(
        warp_model, warp_model.nxn_geom_pair_filtered, warp_model.nxn_pairid_filtered
    )
    # Last, when it is known which contacts have rows.
    loosen = loose_contacts(warp_model)
    at_last = () if loosen is None else (loosen,)
    mending = Mending(always=always, of_theirs=of_theirs, at_last=at_last)
    if mending.hooks():
        # MuJoCo Warp calls it after its own collision pass.
        warp_model.callback.contactfilter = mending


def corrections(warp_model: mjw.Model, pairs: wp.array, pair_ids: wp.array) -> tuple[Hook, ...]:
    """Return the hooks that correct MuJoCo Warp's contacts of pairs, which are listed as in the model."""
    listed = pairs.numpy(), pair_ids.numpy()
    # Each correction is launched only for models that need it: most need none.
    return tuple(hook for hook, is_needed in CORRECTIONS.items() if is_needed(warp_model, *listed))


def align_steep_capsules(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch the turning of contacts of steep capsules with planes, which our own narrow phase need not."""
    contact = warp_data_E.contact
    inputs = [
        warp_model.geom_type,
        warp_data_E.geom_xmat,
        contact.geom,
        contact.worldid,
        warp_data_E.nacon,
    ]
    inputs.append(bool(warp_model.flg_surfacevel))
    outputs = [contact.frame, contact.surfacevel]
    wp.launch(
        kernels.align_steep_capsules, dim=warp_data_E.naconmax, inputs=inputs, outputs=outputs
    )


def _have_capsules_on_planes(
    warp_model: mjw.Model, pairs: np.ndarray, pair_ids: np.ndarray
) -> bool:
    # Sorted by type, since a pair may name either geom first.
    types = np.sort(warp_model.geom_type.numpy()[pairs])
    return bool((types == (kernels.PLANE, kernels.CAPSULE)).all(-1).any())


def drop_upper_corners(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Drop contacts of planes with upper corners of boxes, which our own narrow phase does not make."""
    contact = warp_data_E.contact
    inputs = [warp_model.geom_type, warp_data_E.geom_xpos, warp_data_E.geom_xmat]
    inputs += [contact.geom, contact.worldid, contact.dist, warp_data_E.nacon]
    wp.launch(
        kernels.drop_upper_corners, dim=warp_data_E.naconmax, inputs=inputs, outputs=[contact.type]
    )


def _have_boxes_on_planes(warp_model: mjw.Model, pairs: np.ndarray, pair_ids: np.ndarray) -> bool:
    types = np.sort(warp_model.geom_type.numpy()[pairs])
    return bool((types == (kernels.PLANE, kernels.BOX)).all(-1).any())


def take_the_law_of_priority(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Give contacts the `solref` of the geom with priority, which our own narrow phase does itself."""
    m = warp_model
    contact = warp_data_E.contact
    inputs = [m.geom_priority, m.geom_solref, m.pair_geom1, m.pair_geom2]
    inputs += [contact.geom, contact.worldid, warp_data_E.nacon]
    dim = warp_data_E.naconmax
    wp.launch(kernels.take_the_law_of_priority, dim=dim, inputs=inputs, outputs=[contact.solref])


def _have_direct_laws_of_priority(
    warp_model: mjw.Model, pairs: np.ndarray, pair_ids: np.ndarray
) -> bool:
    """Return whether geoms of different priority may touch where one of them gives stiffness and damping directly."""
    # A <pair> has a law of its own, which no priority changes.
    pairs = pairs[pair_ids[:, 0] == upstream.NO_PAIR]
    differs = np.diff(warp_model.geom_priority.numpy()[pairs])[:, 0] != 0
    # Each world may draw a law of its own at any time.
    is_direct = (warp_model.geom_solref.numpy()[:, :, 0] <= 0.0).any(0) | (
        warp_model.geom_solref.shape[0] > 1
    )
    return bool((differs & is_direct[pairs].any(-1)).any())


def rows_left_out(warp_model: mjw.Model) -> Hook | None:
    """Return a hook that keeps contacts that no joint can heed out of the rows, as in C; None where there are none.

    Only a <pair> can name geoms of one rigid body, or of bodies that never move. In C sensors still read such contacts.
    """
    rigid_body = _rigid_body_of_geoms(warp_model)
    # Without such a <pair>, no kernel needs to be launched.
    if not _has_pairs_within(warp_model, rigid_body):
        return None
    of_geoms = wp.array(rigid_body, dtype=int)

    def leave_out(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        contact = warp_data_E.contact
        nacon = warp_data_E.nacon
        inputs = [of_geoms, contact.geom, nacon]
        outputs = [contact.includemargin, contact.adhesion]
        wp.launch(kernels.leave_out_rows, dim=warp_data_E.naconmax, inputs=inputs, outputs=outputs)

    return leave_out


def _rigid_body_of_geoms(warp_model: mjw.Model) -> np.ndarray:
    """Return the rigid body that each geom belongs to, int [ngeom]."""
    m = warp_model
    rigid_body = m.body_weldid.numpy()[m.geom_bodyid.numpy()]
    # All bodies that no joint moves are one.
    rigid_body[~m.body_isdofancestor.numpy()[rigid_body, : m.nv].any(-1)] = 0
    return rigid_body


def _has_pairs_within(warp_model: mjw.Model, rigid_body: np.ndarray) -> bool:
    """Return whether a <pair> names geoms of one rigid body."""
    first = rigid_body[warp_model.pair_geom1.numpy()]
    second = rigid_body[warp_model.pair_geom2.numpy()]
    return bool((first == second).any())


def has_pairs_of_one_body(warp_model: mjw.Model) -> bool:
    """Return whether contacts may have no rows since no joint moves their geoms apart."""
    return _has_pairs_within(warp_model, _rigid_body_of_geoms(warp_model))


def has_rowless_contacts(warp_model: mjw.Model) -> bool:
    """Return whether contacts may have no rows: those for sensors of distances, and upper corners of boxes."""
    pairs, pair_ids = upstream.geom_pairs(warp_model)
    return warp_model.nsensorcollision > 0 or _have_boxes_on_planes(warp_model, pairs, pair_ids)


def loose_contacts(warp_model: mjw.Model) -> Hook | None:
    """Return a hook that keeps geoms from sticking at contacts without rows; None where nothing could stick there.

    MuJoCo Warp has a contact for each distance that it measures, and each corner of a box on a plane, and lets geoms
    with adhesion pull at all of them.
    """
    if not (warp_model.flg_adhesion and has_rowless_contacts(warp_model)):
        return None

    def loosen(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        contact = warp_data_E.contact
        inputs = [contact.type, warp_data_E.nacon]
        outputs = [contact.adhesion]
        wp.launch(kernels.loosen_rowless, dim=warp_data_E.naconmax, inputs=inputs, outputs=outputs)

    return loosen


CORRECTIONS: dict[Hook, Callable[[mjw.Model, np.ndarray, np.ndarray], bool]] = {
    align_steep_capsules: _have_capsules_on_planes,
    drop_upper_corners: _have_boxes_on_planes,
    take_the_law_of_priority: _have_direct_laws_of_priority,
}
