"""Resets worlds with two kernels, where MuJoCo Warp launches six or more."""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false

import dataclasses
from collections.abc import Callable

import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.views import ACCELERATION_STAGE

LANES = 32
# Arrays that `reset_data` zeroes in a model with none of `HAS_MORE`, and arrays that it leaves though it should not.
_ZEROED = (
    "solver_niter ne nf nl nefc time energy qvel qacc_warmstart qfrc_applied qacc ctrl act act_dot userdata sensordata "
    "xfrc_applied M overflow"
)
ZEROED = (*_ZEROED.split(), *ACCELERATION_STAGE)
HAS_MORE = ("nmocap", "neq", "nflex", "nplastic", "nhistory")


@wp.kernel(enable_backward=False)
def fill_rows(
    mask: wp.array[bool],
    places: wp.array[wp.uint64],
    widths: wp.array[int],
    qpos: wp.array2d[float],
    qpos0: wp.array2d[float],
):
    """Zero the rows of the worlds that `mask` names in arrays [E, width], and put their qpos to the model's."""
    world, lane = wp.tid()
    if not mask[world]:
        return
    # Arrays are given by address, so that one launch fills all of them, whatever their number.
    for k in range(places.shape[0]):
        rows = wp.array(ptr=places[k], shape=(mask.shape[0], widths[k]), dtype=float)
        for i in range(lane, widths[k], LANES):
            rows[world, i] = 0.0
    for i in range(lane, qpos.shape[1], LANES):
        # Worlds may have a pose of their own to reset to.
        qpos[world, i] = qpos0[world % qpos0.shape[0], i]


@wp.kernel(enable_backward=False)
def empty_contacts(
    mask: wp.array[bool],
    nacon: wp.array[int],
    world_of: wp.array[int],
    places: wp.array[wp.uint64],
    widths: wp.array[int],
    efc_address: wp.array2d[int],
):
    """Zero the contacts of the worlds that `mask` names, in arrays [contacts, width]; none has a row."""
    contact = wp.tid()
    # A contact whose world is -1 belongs to no world, and is emptied, too.
    if contact >= nacon[0] or (world_of[contact] >= 0 and not mask[world_of[contact]]):
        return
    for k in range(places.shape[0]):
        rows = wp.array(ptr=places[k], shape=(world_of.shape[0], widths[k]), dtype=float)
        for i in range(widths[k]):
            rows[contact, i] = 0.0
    for i in range(efc_address.shape[1]):
        efc_address[contact, i] = -1
    world_of[contact] = 0


def resets(warp_model: mjw.Model, warp_data_E: mjw.Data, mask: wp.array) -> Callable[[], None]:
    """Return a launcher that puts the worlds of `mask`, bool [E], to `qpos0`, at rest, time 0, without contacts.

    `mjw.reset_data` must have run once: trees stay asleep or awake, unless the model has more.
    """
    m = warp_model
    d = warp_data_E
    contact = warp_data_E.contact
    # These two have other values than 0 after a reset.
    names = {field.name for field in dataclasses.fields(contact)} - {"worldid", "efc_address"}
    device = d.qpos.device

    def table(arrays: list[wp.array], rows: int) -> tuple[wp.array, wp.array]:
        # Empty arrays have no address.
        used = [array for array in arrays if array.size]
        # Widths count floats: every type here has 4 bytes for each number.
        widths = [
            array.size * wp.types.type_size_in_bytes(array.dtype) // 4 // rows for array in used
        ]
        places = wp.array([array.ptr for array in used], dtype=wp.uint64, device=device)
        return places, wp.array(widths, dtype=int, device=device)

    # A body that something adheres to has no contacts after a reset.
    if m.nacttrnbody:
        of_adhesion = ("actuator_moment",)
    else:
        of_adhesion = ()
    of_worlds = table([getattr(d, name) for name in (*ZEROED, *of_adhesion)], d.nworld)
    of_pool = table([getattr(contact, name) for name in sorted(names)], d.naconmax)
    has_more = any(getattr(m, name) for name in HAS_MORE) or bool(
        m.opt.enableflags & mjw.EnableBit.SLEEP
    )

    def launch() -> None:
        # Models with more state need MuJoCo Warp's own reset; ours then zeroes the arrays that it leaves.
        if has_more:
            mjw.reset_data(m, d, reset=mask)
        else:
            pool = [mask, d.nacon, contact.worldid, *of_pool, contact.efc_address]
            wp.launch(empty_contacts, dim=d.naconmax, inputs=pool)
        wp.launch(fill_rows, dim=(d.nworld, LANES), inputs=[mask, *of_worlds, d.qpos, m.qpos0])

    return launch
