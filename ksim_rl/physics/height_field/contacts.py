"""Height fields collide through a kernel of our own instead of MuJoCo Warp's general convex one.

MuJoCo Warp (4.0) treats each triangle as the top of a prism, as C does, and runs GJK and EPA on it. Where a prism's top
is not level, some contacts (about one in 25 of a small ball on a slope or on rough ground) get a depth of centimetres
and a normal straight up or down, which kicks robots; and it keeps fewer contacts than C. A ball, a capsule or a box
against a prism needs no such search: our kernel is exact.

Two kernels find the contacts. The first lists the pairs that have ground within their reach at all, which are few. The
second gives each of them a warp, whose lanes take one prism each: a trunk that lies on stairs has hundreds below it,
and one thread for all of them kept the whole launch waiting.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for, and a number that a loop
# changes has to be made a variable by its type.
# ruff: noqa: UP018
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false

from collections.abc import Callable
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import upstream
from ksim_rl.physics.height_field import convex_contacts
from ksim_rl.physics.height_field.fields import CONTACT_FIELDS, DATA_FIELDS, MODEL_FIELDS
from ksim_rl.physics.height_field.geometry import (
    Core,
    Field,
    Touch,
    field_of,
    field_point,
    prism_of,
    touch_of_core,
    with_normals,
)
from ksim_rl.physics.height_field.parameters import params_of
from ksim_rl.physics.structs import filled, struct_with
from ksim_rl.physics.upstream import make_frame, write_contact

SPHERE, CAPSULE, BOX, HEIGHT_FIELD = (
    int(mjw.GeomType[name]) for name in ("SPHERE", "CAPSULE", "BOX", "HFIELD")
)

# As many contacts as a pair may have in C (`mjMAXCONPAIR`), which leaves out the others in silence.
MOST = wp.constant(int(mujoco.mjMAXCONPAIR))
# A warp for a pair on a GPU; so many of them are launched, and take the listed pairs in turn.
LANES = 32
MOST_WARPS = 16384
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
    # The listed pairs, as pair * worlds + world, and how many they are.
    listed: wp.array[int]
    count: wp.array[int]
    worlds: int
    warps: int


@wp.struct
class Cells:
    """The cells of a lattice below a geom, from one row and column on, and the height of its lowest point."""

    low_row: int
    low_column: int
    rows: int
    columns: int
    lowest: float


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
        core.first_axis = 2
        core.first_edge = 8
        core.num_edges = 1
        core.corner_step = 4
    return core


@wp.func
def reach_of(c: Collisions, pair: int, world: int) -> float:
    """Return the distance up to which a pair has contacts, m."""
    params = params_of(c, pair, world)
    return params[1] + params[2]


@wp.func
def field_below(c: Collisions, pair: int, world: int) -> Field:
    """Return the height field of a pair in one world."""
    patch = c.geom_dataid[world % c.geom_dataid.shape[0], c.pairs[pair][0]]
    return field_of(
        c.hfield_size[patch], c.hfield_nrow[patch], c.hfield_ncol[patch], c.hfield_adr[patch]
    )


@wp.func
def core_in_field(c: Collisions, pair: int, world: int) -> Core:
    """Return the core of a pair's geom in the frame of its field, where the lattice is aligned with the axes."""
    ground = c.pairs[pair][0]
    geom = c.pairs[pair][1]
    field_turn = wp.transpose(c.geom_xmat[world, ground])
    return core_of(
        c.geom_type[geom],
        c.geom_size[world % c.geom_size.shape[0], geom],
        field_turn @ (c.geom_xpos[world, geom] - c.geom_xpos[world, ground]),
        field_turn @ c.geom_xmat[world, geom],
    )


@wp.func
def cells_below(field: Field, core: Core, reach: float) -> Cells:
    """Return the cells below the box of a geom along the axes, grown by the distance at which contacts exist."""
    span = wp.vec3()
    for axis in range(3):
        row_of_turn = wp.vec3(core.turn[axis, 0], core.turn[axis, 1], core.turn[axis, 2])
        span[axis] = wp.dot(wp.abs(row_of_turn), core.half) + core.radius + reach
    center = core.center
    cells = Cells()
    cells.lowest = center[2] - span[2]
    # Nothing is below the base of the ground.
    if center[2] + span[2] < -field.base:
        return cells
    cells.low_column = wp.max(int(wp.floor((center[0] - span[0] + field.half_x) / field.dx)), 0)
    cells.low_row = wp.max(int(wp.floor((center[1] - span[1] + field.half_y) / field.dy)), 0)
    high_column = wp.min(
        int(wp.floor((center[0] + span[0] + field.half_x) / field.dx)), field.columns - 2
    )
    high_row = wp.min(
        int(wp.floor((center[1] + span[1] + field.half_y) / field.dy)), field.rows - 2
    )
    # None beside the field.
    cells.rows = wp.max(high_row - cells.low_row + 1, 0)
    cells.columns = wp.max(high_column - cells.low_column + 1, 0)
    return cells


@wp.kernel(module="unique", module_options={"max_unroll": 1}, enable_backward=False)
def list_near_pairs(c: Collisions):
    """List one pair (height field, geom) of one world if a point of the lattice below the geom reaches up to it."""
    # Neighbouring threads have the same geom in different worlds, so that all have about as many cells.
    pair, world = wp.tid()
    reach = reach_of(c, pair, world)
    field = field_below(c, pair, world)
    core = core_in_field(c, pair, world)
    # The bounding sphere rules out most pairs that are far above all of the ground.
    bound = c.geom_rbound[world % c.geom_rbound.shape[0], c.pairs[pair][1]]
    if core.center[2] - bound > field.top + reach:
        return
    cells = cells_below(field, core, reach)
    if cells.rows == 0 or cells.columns == 0:
        return
    for row in range(cells.low_row, cells.low_row + cells.rows + 1):
        for column in range(cells.low_column, cells.low_column + cells.columns + 1):
            if field_point(field, c.hfield_data, row, column)[2] >= cells.lowest:
                c.listed[wp.atomic_add(c.count, 0, 1)] = pair * c.worlds + world
                return


@wp.kernel(module="unique", module_options={"max_unroll": 1}, enable_backward=False)
def height_field_contacts(c: Collisions):
    """Append the contacts of the listed pairs, one for each prism that a geom touches, in the order of C."""
    warp, lane = wp.tid()
    item = int(warp)
    while item < c.count[0]:
        pair = c.listed[item] // c.worlds
        world = c.listed[item] % c.worlds
        geoms, margin, gap, condim, friction, solref, solreffriction, solimp, adhesion = params_of(
            c, pair, world
        )
        # Contacts exist up to this distance, m.
        reach = margin + gap
        ground = c.pairs[pair][0]
        field_turn = c.geom_xmat[world, ground]
        field = field_below(c, pair, world)
        core = core_in_field(c, pair, world)
        cells = cells_below(field, core, reach)
        num_prisms = 2 * cells.rows * cells.columns
        found = int(0)
        first = int(0)
        # All lanes go through the loop as often as each other, since they count together.
        while first < num_prisms and found <= MOST:
            prism_index = first + lane
            cell = prism_index // 2
            touches = int(0)
            touch = Touch()
            if prism_index < num_prisms:
                prism = prism_of(
                    field,
                    c.hfield_data,
                    cells.low_row + cell // cells.columns,
                    cells.low_column + cell % cells.columns,
                    prism_index % 2,
                )
                # Else the whole prism is below the geom.
                if wp.max(wp.max(prism.a[2], prism.b[2]), prism.c[2]) >= cells.lowest:
                    touch = touch_of_core(with_normals(prism), core, reach)
                    touches = wp.where(touch.distance < reach, 1, 0)
            # How many prisms before its own a lane has found to be touched.
            counted = wp.tile(touches)
            place = found + wp.untile(wp.tile_scan_exclusive(counted))
            total = wp.tile_sum(counted)
            found += total[0]
            if touches == 1 and place < MOST:
                write_contact(
                    c.naconmax,
                    place,
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
            first += wp.block_dim()
        # C leaves out the others in silence; we set a bit of the overflow report.
        if found > MOST and lane == 0:
            wp.atomic_or(c.overflow, world, TOO_MANY)
        item += c.warps


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

    # Made at the first launch for so many worlds, which nothing records.
    memory: dict[str, wp.array] = {}
    lists_of_near: dict[int, dict[str, Any]] = {}

    def append(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        worlds = warp_data_E.nworld
        if is_exact.any():
            num_pairs = int(is_exact.sum())
            if worlds not in lists_of_near:
                lists_of_near[worlds] = {
                    "listed": wp.empty(num_pairs * worlds, dtype=int),
                    "count": wp.zeros(1, dtype=int),
                    "worlds": worlds,
                    "warps": min(num_pairs * worlds, MOST_WARPS),
                }
            near = lists_of_near[worlds]
            near["count"].zero_()
            collisions = filled(Collisions, {**lists[0], **near}, warp_model, warp_data_E)
            wp.launch(list_near_pairs, dim=(num_pairs, worlds), inputs=[collisions])
            wp.launch_tiled(
                height_field_contacts, dim=[near["warps"]], inputs=[collisions], block_dim=LANES
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
