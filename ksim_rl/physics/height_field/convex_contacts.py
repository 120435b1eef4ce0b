"""Cylinders, ellipsoids and meshes collide with each prism of a height field by MuJoCo Warp's search for distances.

Its own kernel keeps four of the contacts that it finds, where C keeps all, and ends the search of some too soon: it
tells corners of a prism apart by their height alone. Here a prism is a mesh of six points.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for, and a number that a loop
# changes has to be made a variable by its type.
# ruff: noqa: UP018
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false

from collections.abc import Mapping

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.height_field.fields import CONTACT_FIELDS, DATA_FIELDS, MODEL_FIELDS
from ksim_rl.physics.height_field.geometry import corner_of_prism, field_of, prism_of
from ksim_rl.physics.height_field.parameters import params_of
from ksim_rl.physics.structs import filled, struct_with
from ksim_rl.physics.upstream import (
    GEOM_TYPES,
    MJ_MAX_EPAFACES,
    MJ_MAX_EPAHORIZON,
    ccd,
    geom_collision_pair,
    make_frame,
    support,
    write_contact,
)

TYPES = tuple(GEOM_TYPES[name] for name in ("CYLINDER", "ELLIPSOID", "MESH"))
MESH = GEOM_TYPES["MESH"]
MOST = wp.constant(int(mujoco.mjMAXCONPAIR))
TOO_MANY = wp.constant(int(mjw.OverflowType.HFIELD))
# Searches in parallel on a GPU, each with its own memory, about 5 kB.
SEARCHES = 8192
# Below this depth, m, the direction from one closest place to the other is rounding of float32.
TOUCHING = wp.constant(1.0e-6)
MESH_FIELDS = (
    "mesh_vertadr mesh_vertnum mesh_graphadr mesh_vert mesh_graph mesh_polynum mesh_polyadr mesh_polynormal "
    "mesh_polyvertadr mesh_polyvertnum mesh_polyvert mesh_polymapadr mesh_polymapnum mesh_polymap"
)


@struct_with(
    ("", mjw.Model, f"{MODEL_FIELDS} {MESH_FIELDS}"),
    ("", mjw.Data, DATA_FIELDS),
    ("contact_", mjw.Contact, CONTACT_FIELDS),
)
class Searches:
    """The arrays that the kernel reads, the memory of searches, and the contacts that it appends to."""

    pairs: wp.array[wp.vec2i]
    pair_ids: wp.array[wp.vec2i]
    ccd_tolerance: wp.array[float]
    iterations: int
    worlds: int
    slots: int
    corners: wp.array2d[wp.vec3]
    vert: wp.array2d[wp.vec3]
    vert_index: wp.array2d[int]
    face: wp.array2d[int]
    face_pr: wp.array2d[wp.vec3]
    face_norm2: wp.array2d[float]
    horizon: wp.array2d[int]


@wp.func
def append_contacts(c: Searches, slot: int, world: int, pair: int):
    """Append the contacts of one pair (height field, geom) in one world, one for each prism that it touches."""
    ground = c.pairs[pair][0]
    geom = c.pairs[pair][1]
    patch = c.geom_dataid[world % c.geom_dataid.shape[0], ground]
    size = c.hfield_size[patch]
    field_turn = c.geom_xmat[world, ground]
    # In the frame of the field, where its lattice is aligned with the axes.
    center = wp.transpose(field_turn) @ (c.geom_xpos[world, geom] - c.geom_xpos[world, ground])
    bound = c.geom_rbound[world % c.geom_rbound.shape[0], geom]
    geoms, margin, gap, condim, friction, solref, solreffriction, solimp, adhesion = params_of(
        c, pair, world
    )
    # The bounding sphere rules most pairs out before any search.
    reach = margin + gap
    if center[2] - bound > size[2] + reach or center[2] + bound < -size[3] - reach:
        return
    if wp.abs(center[0]) - bound > size[0] + reach or wp.abs(center[1]) - bound > size[1] + reach:
        return

    kind = c.geom_type[geom]
    # MuJoCo Warp's own description of both geoms, which its search takes.
    below, shape = geom_collision_pair(
        c.geom_type,
        c.geom_dataid,
        c.geom_size,
        c.mesh_vertadr,
        c.mesh_vertnum,
        c.mesh_graphadr,
        c.mesh_vert,
        c.mesh_graph,
        c.mesh_polynum,
        c.mesh_polyadr,
        c.mesh_polynormal,
        c.mesh_polyvertadr,
        c.mesh_polyvertnum,
        c.mesh_polyvert,
        c.mesh_polymapadr,
        c.mesh_polymapnum,
        c.mesh_polymap,
        c.geom_xpos,
        c.geom_xmat,
        geoms,
        world,
    )
    # The geom is moved into the frame of the field.
    shape.pos = center
    shape.rot = wp.transpose(field_turn) @ shape.rot
    # The prism, as a mesh of six points in the frame of the field.
    below.pos = wp.vec3(0.0)
    below.rot = wp.identity(n=3, dtype=float)
    below.vert = c.corners[slot]
    below.vertadr = 0
    below.vertnum = 6
    below.graphadr = -1
    # The geom's box along the axes, grown by the distance at which contacts exist.
    low = wp.vec3()
    high = wp.vec3()
    for axis in range(3):
        along = wp.vec3()
        along[axis] = 1.0
        low[axis] = support(shape, kind, -along).point[axis] - reach
        high[axis] = support(shape, kind, along).point[axis] + reach

    # The cells of the lattice below that box.
    field = field_of(size, c.hfield_nrow[patch], c.hfield_ncol[patch], c.hfield_adr[patch])
    low_column = wp.max(int(wp.floor((low[0] + field.half_x) / field.dx)), 0)
    low_row = wp.max(int(wp.floor((low[1] + field.half_y) / field.dy)), 0)
    high_column = wp.min(int(wp.floor((high[0] + field.half_x) / field.dx)), field.columns - 2)
    high_row = wp.min(int(wp.floor((high[1] + field.half_y) / field.dy)), field.rows - 2)
    tolerance = c.ccd_tolerance[world % c.ccd_tolerance.shape[0]]
    found = int(0)
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            for half in range(2):
                prism = prism_of(field, c.hfield_data, row, column, half)
                # The whole prism is below the geom.
                if wp.max(wp.max(prism.a[2], prism.b[2]), prism.c[2]) < low[2]:
                    continue
                middle = wp.vec3()
                # The search starts from a point inside of each shape: of the prism, the mean of its corners.
                for corner in range(6):
                    point = corner_of_prism(prism, corner)
                    c.corners[slot, corner] = point
                    middle = middle + point / 6.0
                # Supports that the search remembers belong to the prism before.
                below.index = -1
                shape.index = -1
                distance, count, own, other, _ = ccd(
                    tolerance,
                    reach,
                    c.iterations,
                    c.iterations,
                    below,
                    shape,
                    MESH,
                    kind,
                    middle,
                    center,
                    c.vert[slot],
                    c.vert_index[slot],
                    c.face[slot],
                    c.face_pr[slot],
                    c.face_norm2[slot],
                    c.horizon[slot],
                    False,
                    world,
                    c.overflow,
                )
                # Beyond the reach, or no distance was found.
                if count == 0 or distance >= reach:
                    continue
                if found == MOST:
                    wp.atomic_or(c.overflow, world, TOO_MANY)
                    return
                # From the field to the geom, also where they are in each other.
                normal = wp.where(distance < 0.0, own - other, other - own)
                # So close, the two places say nothing: the direction between the centres has to do.
                if wp.abs(distance) < TOUCHING:
                    normal = shape.pos - middle
                write_contact(
                    c.naconmax,
                    found,
                    distance,
                    field_turn @ (0.5 * (own + other)) + c.geom_xpos[world, ground],
                    make_frame(field_turn @ normal),
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


@wp.kernel(module="unique", enable_backward=False)
def convex_height_field_contacts(c: Searches):
    """Search through all pairs of all worlds, as many in parallel as there is memory for."""
    # Each thread takes every `slots`-th pair, since it owns the memory of one search.
    slot = wp.tid()
    pairs = c.pairs.shape[0]
    item = int(slot)
    while item < c.worlds * pairs:
        append_contacts(c, slot, item // pairs, item % pairs)
        item += c.slots


def append(own: Mapping[str, wp.array], warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch the kernel for pairs of height fields and geoms, with the memory for it, as `Searches` has them."""
    slots = own["vert"].shape[0]
    opt = warp_model.opt
    numbers = {"iterations": int(opt.ccd_iterations), "worlds": warp_data_E.nworld, "slots": slots}
    owners = {**own, **numbers, "ccd_tolerance": opt.ccd_tolerance}, warp_model, warp_data_E
    wp.launch(convex_height_field_contacts, dim=slots, inputs=[filled(Searches, *owners)])


def memory_for(
    warp_model: mjw.Model, warp_data_E: mjw.Data, *, num_pairs: int
) -> dict[str, wp.array]:
    """Return the memory of searches: vertices, faces and edges of their polytopes. On a CPU there is one at a time."""
    # Memory for each pair at the same time would be too much on a GPU.
    if warp_data_E.qpos.device.is_cuda:
        slots = min(SEARCHES, warp_data_E.nworld * num_pairs)
    else:
        slots = 1
    iterations = int(warp_model.opt.ccd_iterations)
    # The sizes by which MuJoCo Warp's search indexes these arrays.
    faces = 6 + MJ_MAX_EPAFACES * iterations
    vertices = 10 + 2 * iterations
    return {
        "corners": wp.empty((slots, 6), dtype=wp.vec3),
        "vert": wp.empty((slots, vertices), dtype=wp.vec3),
        "vert_index": wp.empty((slots, vertices), dtype=int),
        "face": wp.empty((slots, faces), dtype=int),
        "face_pr": wp.empty((slots, faces), dtype=wp.vec3),
        "face_norm2": wp.empty((slots, faces), dtype=float),
        "horizon": wp.empty((slots, MJ_MAX_EPAHORIZON), dtype=int),
    }
