"""This Warp kernel finds the contacts of spheres, capsules and boxes with height fields."""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for, and a number that a loop
# changes has to be made a variable by its type.
# ruff: noqa: UP018
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false

import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.height_field.geometry import (
    FAR,
    PEAK,
    Field,
    closest_ground,
    closest_ridge,
    field_point,
    ground_at,
    is_over,
)
from ksim_rl.physics.upstream import contact_params, make_frame, write_contact

SPHERE, CAPSULE, BOX = (int(mjw.GeomType[name]) for name in ("SPHERE", "CAPSULE", "BOX"))

vec5 = wp.types.vector(length=5, dtype=float)
mat43 = wp.types.matrix(shape=(4, 3), dtype=float)


@wp.struct
class Touches:
    """Up to four contacts of a geom, in the field's frame: signed distances, places on the geom, and normals."""

    count: int
    distance: wp.vec4
    place: mat43
    normal: mat43


@wp.func
def add_touch(touches: Touches, distance: float, place: wp.vec3, normal: wp.vec3) -> Touches:
    """Append a contact, or replace the shallowest by it if it is deeper and there is no room."""
    slot = touches.count
    if slot == 4:
        slot = int(0)
        for i in range(1, 4):
            if touches.distance[i] > touches.distance[slot]:
                slot = i
        if distance >= touches.distance[slot]:
            return touches
    else:
        touches.count = slot + 1
    touches.distance[slot] = distance
    touches.place[slot] = place
    touches.normal[slot] = normal
    return touches


@wp.func
def ball_touches(
    touches: Touches,
    field: Field,
    data: wp.array[float],
    center: wp.vec3,
    radius: float,
    margin: float,
    most: int,
) -> Touches:
    """Add up to `most` contacts of a ball."""
    if not is_over(field, center):
        return touches
    below = ground_at(field, data, center)
    if below.distance < 0.0:
        return add_touch(touches, below.distance - radius, center - radius * below.normal, below.normal)
    first, second = wp.vec3(0.0), wp.vec3(0.0)
    for found in range(most):
        touch = closest_ground(field, data, center, radius + margin, found, first, second)
        if touch.distance == FAR:
            break
        touches = add_touch(touches, touch.distance - radius, center - radius * touch.normal, touch.normal)
        if found == 0:
            first = touch.normal
        else:
            second = touch.normal
    return touches


@wp.func
def capsule_touches(
    field: Field,
    data: wp.array[float],
    center: wp.vec3,
    axis: wp.vec3,
    radius: float,
    margin: float,
) -> Touches:
    """Return the contacts of a capsule: one at each end, and one where a ridge presses into its side."""
    touches = Touches()
    touches = ball_touches(touches, field, data, center + axis, radius, margin, 1)
    touches = ball_touches(touches, field, data, center - axis, radius, margin, 1)
    distance, parameter, normal = closest_ridge(field, data, center - axis, 2.0 * axis, radius + margin)
    if distance < FAR:
        place = center + (2.0 * parameter - 1.0) * axis - radius * normal
        touches = add_touch(touches, distance - radius, place, normal)
    return touches


@wp.func
def box_touches(
    field: Field, data: wp.array[float], center: wp.vec3, turn: wp.mat33, half: wp.vec3, margin: float
) -> Touches:
    """Return the deepest four contacts of a box: its corners on the ground, and peaks of the ground in its faces."""
    touches = Touches()
    for corner in range(8):
        signs = wp.vec3(
            wp.where((corner & 1) == 0, -1.0, 1.0),
            wp.where((corner & 2) == 0, -1.0, 1.0),
            wp.where((corner & 4) == 0, -1.0, 1.0),
        )
        point = center + turn @ wp.cw_mul(signs, half)
        if is_over(field, point):
            below = ground_at(field, data, point)
            if below.distance < margin:
                touches = add_touch(touches, below.distance, point, below.normal)

    reach = wp.vec3()
    for i in range(3):
        reach[i] = wp.abs(turn[i, 0]) * half[0] + wp.abs(turn[i, 1]) * half[1] + wp.abs(turn[i, 2]) * half[2]
    # Points on the rim of the field have no neighbours to stand out above.
    low_column = wp.max(int(wp.ceil((center[0] - reach[0] + field.half_x) / field.dx)), 1)
    low_row = wp.max(int(wp.ceil((center[1] - reach[1] + field.half_y) / field.dy)), 1)
    high_column = wp.min(int(wp.floor((center[0] + reach[0] + field.half_x) / field.dx)), field.columns - 2)
    high_row = wp.min(int(wp.floor((center[1] + reach[1] + field.half_y) / field.dy)), field.rows - 2)
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            point = field_point(field, data, row, column)
            if point[2] < center[2] - reach[2]:
                continue
            inside = wp.transpose(turn) @ (point - center)
            depth, face = float(FAR), int(0)
            for i in range(3):
                gap = half[i] - wp.abs(inside[i])
                # The way out of the ground goes up: a face on top of the box does not count.
                out = wp.where(inside[i] < 0.0, 1.0, -1.0) * turn[2, i]
                if gap < 0.0:
                    depth = -1.0
                    break
                if out >= 0.0 and gap < depth:
                    depth, face = gap, i
            if depth < 0.0 or depth == FAR:
                continue
            around = (
                field_point(field, data, row - 1, column)[2]
                + field_point(field, data, row + 1, column)[2]
                + field_point(field, data, row, column - 1)[2]
                + field_point(field, data, row, column + 1)[2]
            )
            if point[2] - 0.25 * around < PEAK:
                continue
            sign = wp.where(inside[face] < 0.0, 1.0, -1.0)
            normal = sign * wp.vec3(turn[0, face], turn[1, face], turn[2, face])
            touches = add_touch(touches, -depth, point - depth * normal, normal)
    return touches


@wp.kernel(module="unique", enable_backward=False)
def height_field_contacts(
    pairs: wp.array[wp.vec2i],
    pair_ids: wp.array[wp.vec2i],
    geom_type: wp.array[int],
    geom_condim: wp.array[int],
    geom_dataid: wp.array2d[int],
    geom_priority: wp.array[int],
    geom_solmix: wp.array2d[float],
    geom_solref: wp.array2d[wp.vec2],
    geom_solimp: wp.array2d[vec5],
    geom_size: wp.array2d[wp.vec3],
    geom_rbound: wp.array2d[float],
    geom_friction: wp.array2d[wp.vec3],
    geom_margin: wp.array2d[float],
    geom_gap: wp.array2d[float],
    geom_adhesion: wp.array2d[float],
    hfield_size: wp.array[wp.vec4],
    hfield_nrow: wp.array[int],
    hfield_ncol: wp.array[int],
    hfield_adr: wp.array[int],
    hfield_data: wp.array[float],
    pair_dim: wp.array[int],
    pair_solref: wp.array2d[wp.vec2],
    pair_solreffriction: wp.array2d[wp.vec2],
    pair_solimp: wp.array2d[vec5],
    pair_margin: wp.array2d[float],
    pair_gap: wp.array2d[float],
    pair_adhesion: wp.array2d[float],
    pair_friction: wp.array2d[vec5],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
    naconmax: int,
    contact_dist: wp.array[float],
    contact_pos: wp.array[wp.vec3],
    contact_frame: wp.array[wp.mat33],
    contact_includemargin: wp.array[float],
    contact_friction: wp.array[vec5],
    contact_solref: wp.array[wp.vec2],
    contact_solreffriction: wp.array[wp.vec2],
    contact_solimp: wp.array[vec5],
    contact_dim: wp.array[int],
    contact_geom: wp.array[wp.vec2i],
    contact_efc_address: wp.array2d[int],
    contact_worldid: wp.array[int],
    contact_type: wp.array[int],
    contact_geomcollisionid: wp.array[int],
    contact_adhesion: wp.array[float],
    nacon: wp.array[int],
):
    """Append the contacts of one pair (height field, geom) in one world, at most four."""
    world, pair = wp.tid()
    ground, geom = pairs[pair][0], pairs[pair][1]
    patch = geom_dataid[world % geom_dataid.shape[0], ground]
    size = hfield_size[patch]
    field_turn = geom_xmat[world, ground]
    center = wp.transpose(field_turn) @ (geom_xpos[world, geom] - geom_xpos[world, ground])
    bound = geom_rbound[world % geom_rbound.shape[0], geom]
    geoms, margin, gap, condim, friction, solref, solreffriction, solimp, adhesion = contact_params(
        geom_condim,
        geom_priority,
        geom_solmix,
        geom_solref,
        geom_solimp,
        geom_friction,
        geom_margin,
        geom_gap,
        geom_adhesion,
        pair_dim,
        pair_solref,
        pair_solreffriction,
        pair_solimp,
        pair_margin,
        pair_gap,
        pair_adhesion,
        pair_friction,
        pairs,
        pair_ids,
        pair,
        world,
    )
    reach = margin + gap
    if center[2] - bound > size[2] + reach:
        return
    if wp.abs(center[0]) - bound > size[0] or wp.abs(center[1]) - bound > size[1]:
        return

    field = Field()
    field.address = hfield_adr[patch]
    field.rows = hfield_nrow[patch]
    field.columns = hfield_ncol[patch]
    field.half_x = size[0]
    field.half_y = size[1]
    field.top = size[2]
    field.dx = 2.0 * size[0] / float(field.columns - 1)
    field.dy = 2.0 * size[1] / float(field.rows - 1)
    shape = geom_size[world % geom_size.shape[0], geom]
    turn = wp.transpose(field_turn) @ geom_xmat[world, geom]
    touches = Touches()
    if geom_type[geom] == SPHERE:
        touches = ball_touches(touches, field, hfield_data, center, shape[0], reach, 3)
    elif geom_type[geom] == CAPSULE:
        axis = shape[1] * wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
        touches = capsule_touches(field, hfield_data, center, axis, shape[0], reach)
    else:
        touches = box_touches(field, hfield_data, center, turn, shape, reach)

    for i in range(touches.count):
        distance = touches.distance[i]
        normal = field_turn @ touches.normal[i]
        place = field_turn @ touches.place[i] + geom_xpos[world, ground]
        write_contact(
            naconmax,
            i,
            distance,
            # Half-way between the surfaces.
            place - 0.5 * distance * normal,
            make_frame(normal),
            margin,
            gap,
            condim,
            friction,
            solref,
            solreffriction,
            solimp,
            adhesion,
            geoms,
            pair_ids[pair],
            world,
            contact_dist,
            contact_pos,
            contact_frame,
            contact_includemargin,
            contact_friction,
            contact_solref,
            contact_solreffriction,
            contact_solimp,
            contact_dim,
            contact_geom,
            contact_efc_address,
            contact_worldid,
            contact_type,
            contact_geomcollisionid,
            contact_adhesion,
            nacon,
        )
