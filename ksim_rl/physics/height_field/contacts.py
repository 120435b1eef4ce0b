"""Height fields collide through a kernel of our own instead of MuJoCo Warp's general convex one.

MuJoCo Warp (4.0) treats each triangle as the top of a prism, as C does, and runs GJK and EPA on it. Where a prism's top
is not level, some contacts (about one in 25 of a small ball on a slope or on rough ground) get a depth of centimetres
and a normal straight up or down, which kicks robots; and it keeps fewer contacts than C. A ball, a capsule or a box
against a prism needs no such search: our kernel is exact.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for, and a number that a loop
# changes has to be made a variable by its type.
# ruff: noqa: UP018
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import upstream
from ksim_rl.physics.height_field import convex_contacts
from ksim_rl.physics.height_field.fields import CONTACT_FIELDS, DATA_FIELDS, MODEL_FIELDS
from ksim_rl.physics.height_field.geometry import Core, field_of, prism_of, touch_of_core
from ksim_rl.physics.structs import filled, struct_with
from ksim_rl.physics.upstream import contact_params, make_frame, write_contact

SPHERE, CAPSULE, BOX, HEIGHT_FIELD = (
    int(mjw.GeomType[name]) for name in ("SPHERE", "CAPSULE", "BOX", "HFIELD")
)

# As many contacts as a pair may have in C (`mjMAXCONPAIR`), which leaves out the others in silence.
MOST = wp.constant(int(mujoco.mjMAXCONPAIR))
TOO_MANY = wp.constant(int(mjw.OverflowType.HFIELD))


@struct_with(
    ("", mjw.Model, MODEL_FIELDS),
    ("", mjw.Data, DATA_FIELDS),
    ("contact_", mjw.Contact, CONTACT_FIELDS),
)
class Collisions:
    """The arrays of a model and its worlds that the kernel reads, and the contacts that it appends to."""

    pairs: wp.array[wp.vec2i]
    pair_ids: wp.array[wp.vec2i]


@wp.func
def core_of(kind: int, size: wp.vec3, center: wp.vec3, turn: wp.mat33) -> Core:
    """Return the core of a sphere, a capsule or a box."""
    core = Core()
    core.center = center
    core.turn = turn
    # All 12 edges and 8 corners; a box has no radius.
    if kind == BOX:
        core.half = size
        core.num_edges = 12
        core.corner_step = 1
        return core
    # A sphere's centre is all 8 corners of a box without size: one of them is enough.
    core.radius = size[0]
    core.corner_step = 8
    if kind == CAPSULE:
        # The edge of a box along its third axis.
        core.half = wp.vec3(0.0, 0.0, size[1])
        core.first_edge = 8
        core.num_edges = 1
        core.corner_step = 4
    return core


@wp.kernel(module="unique", module_options={"max_unroll": 1}, enable_backward=False)
def height_field_contacts(c: Collisions):
    """Append the contacts of one pair (height field, geom) in one world, one for each prism that it touches."""
    world, pair = wp.tid()
    ground = c.pairs[pair][0]
    geom = c.pairs[pair][1]
    patch = c.geom_dataid[world % c.geom_dataid.shape[0], ground]
    size = c.hfield_size[patch]
    field_turn = c.geom_xmat[world, ground]
    # In the frame of the field, where its lattice is aligned with the axes.
    center = wp.transpose(field_turn) @ (c.geom_xpos[world, geom] - c.geom_xpos[world, ground])
    bound = c.geom_rbound[world % c.geom_rbound.shape[0], geom]
    geoms, margin, gap, condim, friction, solref, solreffriction, solimp, adhesion = contact_params(
        c.geom_condim,
        c.geom_priority,
        c.geom_solmix,
        c.geom_solref,
        c.geom_solimp,
        c.geom_friction,
        c.geom_margin,
        c.geom_gap,
        c.geom_adhesion,
        c.pair_dim,
        c.pair_solref,
        c.pair_solreffriction,
        c.pair_solimp,
        c.pair_margin,
        c.pair_gap,
        c.pair_adhesion,
        c.pair_friction,
        c.pairs,
        c.pair_ids,
        pair,
        world,
    )
    if c.pair_ids[pair][0] < 0 and c.geom_priority[ground] != c.geom_priority[geom]:
        # The parameters of the geom with priority hold alone, which MuJoCo Warp's function does not know of this one.
        stronger = wp.where(c.geom_priority[ground] > c.geom_priority[geom], ground, geom)
        solref = c.geom_solref[world % c.geom_solref.shape[0], stronger]
    # Contacts exist up to this distance, m; the bounding sphere rules most pairs out.
    reach = margin + gap
    if center[2] - bound > size[2] + reach or center[2] + bound < -size[3] - reach:
        return
    if wp.abs(center[0]) - bound > size[0] + reach or wp.abs(center[1]) - bound > size[1] + reach:
        return

    field = field_of(size, c.hfield_nrow[patch], c.hfield_ncol[patch], c.hfield_adr[patch])
    core = core_of(
        c.geom_type[geom],
        c.geom_size[world % c.geom_size.shape[0], geom],
        center,
        wp.transpose(field_turn) @ c.geom_xmat[world, geom],
    )
    # How far the geom is from its centre along each axis, with the distance at which contacts exist.
    span = wp.vec3()
    for axis in range(3):
        row_of_turn = wp.vec3(core.turn[axis, 0], core.turn[axis, 1], core.turn[axis, 2])
        span[axis] = wp.dot(wp.abs(row_of_turn), core.half) + core.radius + reach
    # The cells of the lattice below the geom's box.
    low_column = wp.max(int(wp.floor((center[0] - span[0] + field.half_x) / field.dx)), 0)
    low_row = wp.max(int(wp.floor((center[1] - span[1] + field.half_y) / field.dy)), 0)
    high_column = wp.min(
        int(wp.floor((center[0] + span[0] + field.half_x) / field.dx)), field.columns - 2
    )
    high_row = wp.min(
        int(wp.floor((center[1] + span[1] + field.half_y) / field.dy)), field.rows - 2
    )
    found = int(0)
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            for half in range(2):
                prism = prism_of(field, c.hfield_data, row, column, half)
                # The whole prism is below the geom.
                if wp.max(wp.max(prism.a[2], prism.b[2]), prism.c[2]) < center[2] - span[2]:
                    continue
                touch = touch_of_core(prism, core, reach)
                if touch.distance >= reach:
                    continue
                # C stops here in silence; we set a bit of the overflow report.
                if found == MOST:
                    wp.atomic_or(c.overflow, world, TOO_MANY)
                    return
                write_contact(
                    c.naconmax,
                    found,
                    touch.distance,
                    field_turn @ touch.place + c.geom_xpos[world, ground],
                    make_frame(field_turn @ touch.normal),
                    margin,
                    gap,
                    condim,
                    friction,
                    solref,
                    solreffriction,
                    solimp,
                    adhesion,
                    geoms,
                    c.pair_ids[pair],
                    world,
                    c.contact_dist,
                    c.contact_pos,
                    c.contact_frame,
                    c.contact_includemargin,
                    c.contact_friction,
                    c.contact_solref,
                    c.contact_solreffriction,
                    c.contact_solimp,
                    c.contact_dim,
                    c.contact_geom,
                    c.contact_efc_address,
                    c.contact_worldid,
                    c.contact_type,
                    c.contact_geomcollisionid,
                    c.contact_adhesion,
                    c.nacon,
                )
                found += 1


def take_over_height_fields(warp_model: mjw.Model) -> Callable[[mjw.Model, mjw.Data], None] | None:
    """Take the pairs of height fields away from MuJoCo Warp, in place.

    Returns a hook that appends their contacts after its collision pass, or None where there are no such pairs. Pairs
    with signed distance fields stay with MuJoCo Warp.
    """
    geom_type = warp_model.geom_type.numpy()
    # The kernel expects the height field first.
    pairs, pair_ids = upstream.geom_pairs(warp_model)
    types = geom_type[pairs]
    height_first = np.where(types[:, :1] == HEIGHT_FIELD, pairs, pairs[:, ::-1])
    others = geom_type[height_first[:, 1]]
    # Pairs that only a sensor measures are left to MuJoCo Warp.
    touches = (types == HEIGHT_FIELD).any(-1) & (pair_ids[:, 0] > upstream.NO_CONTACT)
    is_exact = touches & np.isin(others, (SPHERE, CAPSULE, BOX))
    is_convex = touches & np.isin(others, convex_contacts.TYPES)
    taken = is_exact | is_convex
    if not taken.any():
        return None
    upstream.drop_contacts(warp_model, taken)
    lists = [
        {
            "pairs": wp.array(height_first[chosen], dtype=wp.vec2i),
            "pair_ids": wp.array(pair_ids[chosen], dtype=wp.vec2i),
        }
        for chosen in (is_exact, is_convex)
    ]

    # Made at the first launch, which nothing records, since it depends on the number of worlds.
    memory: dict[str, wp.array] = {}

    def append(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        if is_exact.any():
            collisions = filled(Collisions, lists[0], warp_model, warp_data_E)
            wp.launch(
                height_field_contacts,
                dim=(warp_data_E.nworld, int(is_exact.sum())),
                inputs=[collisions],
            )
        if is_convex.any():
            if not memory:
                memory.update(
                    convex_contacts.memory_for(
                        warp_model, warp_data_E, num_pairs=int(is_convex.sum())
                    )
                )
            convex_contacts.append({**lists[1], **memory}, warp_model, warp_data_E)
        # Our kernels write no velocity of a surface.
        if warp_model.flg_surfacevel:
            upstream.give_velocities_of_surfaces(warp_model, warp_data_E)

    return append
