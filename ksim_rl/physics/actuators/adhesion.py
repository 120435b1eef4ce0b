"""Computes the transmissions of actuators that adhere to a body, whose moments its contacts decide.

Such an actuator pulls along the mean of the normals of a body's contacts. MuJoCo Warp counts the pairs of geoms whose
distance a sensor reads among the contacts, and upper corners of boxes on planes, and pairs of one rigid body, so that
the pull is weaker than C's: here they are hidden from it. And no refresh looks for contacts, so that these moments stay
as the last substep left them; rows that reset read zero.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false, reportArgumentType=false

import dataclasses
from collections.abc import Callable

import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics import kernels, upstream
from ksim_rl.physics.contacts import has_pairs_of_one_body, has_rowless_contacts

CONSTRAINT = int(upstream.ContactType.CONSTRAINT)


def miscounts_contacts(warp_model: mjw.Model) -> bool:
    """Whether MuJoCo Warp's transmissions count contacts without rows as contacts of a body."""
    if warp_model.nacttrnbody == 0:
        return False
    return has_rowless_contacts(warp_model) or has_pairs_of_one_body(warp_model)


def transmissions_of_contacts(warp_model: mjw.Model, warp_data_E: mjw.Data) -> Callable[[], None]:
    """Return a launcher of MuJoCo Warp's `transmission` with contacts alone, once there are constraint rows."""
    contact = warp_data_E.contact
    # A copy of the geoms, so that other readers see all contacts.
    geom = wp.empty_like(contact.geom)
    hiding = dataclasses.replace(warp_data_E, contact=dataclasses.replace(contact, geom=geom))
    d = warp_data_E
    inputs = [contact.geom, contact.type, contact.includemargin, d.nacon]

    def launch() -> None:
        wp.launch(_hide_rowless, dim=d.naconmax, inputs=inputs, outputs=[geom])
        mjw.transmission(warp_model, hiding)
        # In a stage of Runge-Kutta they have been found already, by the wrong moments.
        pattern = (d.moment_rownnz, d.moment_rowadr, d.moment_colind)
        kernels.multiply_by_qvel(pattern, d.actuator_moment, d.qvel, d.actuator_velocity)

    return launch


def transmissions_of_refresh(warp_model: mjw.Model, warp_data_E: mjw.Data) -> Callable[[], None]:
    """Return a launcher of MuJoCo Warp's `transmission` for all actuators but those that adhere to a body."""
    m = warp_model
    d = warp_data_E
    if m.nacttrnbody == 0:
        return lambda: mjw.transmission(m, d)
    # All actuators but those that adhere: their moments would be computed from contacts, which a refresh does not find.
    without_contacts = dataclasses.replace(m, nacttrnbody=0)
    shape = (d.nworld, m.nacttrnbody, m.nv)
    kept = wp.empty(shape, dtype=float)
    rows = (m.actuator_trntype_body_adr, d.moment_rowadr)

    def launch() -> None:
        # The rows of a world may lie elsewhere after each launch.
        wp.launch(_gather_moments, dim=shape, inputs=[*rows, d.actuator_moment], outputs=[kept])
        mjw.transmission(without_contacts, d)
        wp.launch(_scatter_moments, dim=shape, inputs=[*rows, kept], outputs=[d.actuator_moment])

    return launch


@wp.kernel(enable_backward=False)
def _gather_moments(
    actuators: wp.array[int],
    rowadr: wp.array2d[int],
    moment: wp.array2d[float],
    kept: wp.array3d[float],
):
    """Copy the moments of some actuators; each has all degrees of freedom in its row."""
    world, place, dof = wp.tid()
    kept[world, place, dof] = moment[world, rowadr[world, actuators[place]] + dof]


@wp.kernel(enable_backward=False)
def _scatter_moments(
    actuators: wp.array[int],
    rowadr: wp.array2d[int],
    kept: wp.array3d[float],
    moment: wp.array2d[float],
):
    """Put back the moments that `_gather_moments` has copied."""
    world, place, dof = wp.tid()
    moment[world, rowadr[world, actuators[place]] + dof] = kept[world, place, dof]


@wp.kernel(enable_backward=False)
def _hide_rowless(
    geom: wp.array[wp.vec2i],
    kind: wp.array[int],
    includemargin: wp.array[float],
    nacon: wp.array[int],
    shown: wp.array[wp.vec2i],
):
    """Copy the geoms of contacts; without rows they become -1, which MuJoCo Warp passes over.

    Contacts in a gap are shown: C counts them, though they have no rows either.
    """
    contact = wp.tid()
    if contact >= nacon[0]:
        return
    is_within_a_body = includemargin[contact] <= kernels.NO_ROWS
    if kind[contact] & CONSTRAINT and not is_within_a_body:
        shown[contact] = geom[contact]
    else:
        shown[contact] = wp.vec2i(-1, -1)
