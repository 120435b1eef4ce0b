"""Height fields collide through a kernel of our own instead of MuJoCo Warp's general convex one.

MuJoCo Warp (4.0) treats each triangle as the top of a prism and runs GJK and EPA on it. Where a prism's top is not
level, some contacts (about one in 25 of a small ball on a slope or on rough ground) get a depth of centimetres and a
normal straight up or down, which kicks robots. A ball, a capsule or a box against triangles needs no such search: our
kernel is exact, and cheaper.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for, and a number that a loop
# changes has to be made a variable by its type.
# ruff: noqa: UP018
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false

from collections.abc import Callable

import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import upstream
from ksim_rl.physics.height_field.geometry import (
    FAR,
    PEAK,
    Field,
    closest_ground,
    closest_of_segments,
    closest_ridge,
    field_point,
    ground_at,
    is_over,
    is_ridge,
    ridge_normal,
)
from ksim_rl.physics.structs import filled, struct_with
from ksim_rl.physics.upstream import contact_params, make_frame, write_contact

SPHERE, CAPSULE, BOX, HEIGHT_FIELD = (
    int(mjw.GeomType[name]) for name in ("SPHERE", "CAPSULE", "BOX", "HFIELD")
)

# The cosine up to which a face of a box lies on a ridge, so that both of its edges touch it.
FLAT = wp.constant(0.1)

mat43 = wp.types.matrix(shape=(4, 3), dtype=float)


@wp.struct
class Touches:
    """Up to four contacts of a geom, in the field's frame: signed distances, places on the geom, and normals."""

    count: int
    distance: wp.vec4
    place: mat43
    normal: mat43


@struct_with(
    (
        "",
        mjw.Model,
        "geom_type geom_condim geom_dataid geom_priority geom_solmix geom_solref geom_solimp geom_size geom_rbound "
        "geom_friction geom_margin geom_gap geom_adhesion hfield_size hfield_nrow hfield_ncol hfield_adr hfield_data "
        "pair_dim pair_solref pair_solreffriction pair_solimp pair_margin pair_gap pair_adhesion pair_friction",
    ),
    ("", mjw.Data, "geom_xpos geom_xmat naconmax nacon"),
    (
        "contact_",
        mjw.Contact,
        "dist pos frame includemargin friction solref solreffriction solimp dim geom efc_address worldid type "
        "geomcollisionid adhesion",
    ),
)
class Collisions:
    """What the kernel reads of a model and its worlds, and the contacts that it appends to."""

    pairs: wp.array[wp.vec2i]
    pair_ids: wp.array[wp.vec2i]


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
    field: Field, data: wp.array[float], center: wp.vec3, axis: wp.vec3, radius: float, margin: float
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
    """Return the deepest four contacts of a box: its corners on the ground, peaks in its faces, edges on ridges."""
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
    return edge_touches(touches, field, data, center, turn, half, reach, margin)


@wp.func
def edge_touches(
    touches: Touches,
    field: Field,
    data: wp.array[float],
    center: wp.vec3,
    turn: wp.mat33,
    half: wp.vec3,
    reach: wp.vec3,
    margin: float,
) -> Touches:
    """Add the contacts of a box's edges with ridges that they cross."""
    low_column = wp.max(int(wp.floor((center[0] - reach[0] + field.half_x) / field.dx)), 0)
    low_row = wp.max(int(wp.floor((center[1] - reach[1] + field.half_y) / field.dy)), 0)
    high_column = wp.min(int(wp.floor((center[0] + reach[0] + field.half_x) / field.dx)), field.columns - 2)
    high_row = wp.min(int(wp.floor((center[1] + reach[1] + field.half_y) / field.dy)), field.rows - 2)
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            a = field_point(field, data, row, column)
            for kind in range(3):
                to_end = (
                    field_point(
                        field, data, row + wp.where(kind == 0, 0, 1), column + wp.where(kind == 1, 0, 1)
                    )
                    - a
                )
                if a[2] + wp.max(to_end[2], 0.0) < center[2] - reach[2] - margin:
                    continue
                if not is_ridge(field, data, row, column, kind):
                    continue
                for axis in range(3):
                    along = wp.vec3(turn[0, axis], turn[1, axis], turn[2, axis])
                    normal = ridge_normal(field, data, row, column, kind, along)
                    out = wp.transpose(turn) @ normal
                    # The edges along this axis that are lowest along the normal: two where a face lies on the ridge.
                    for edge in range(4):
                        one, other = (axis + 1) % 3, (axis + 2) % 3
                        corner = wp.vec3()
                        corner[axis] = -half[axis]
                        corner[one] = wp.where((edge & 1) == 0, half[one], -half[one])
                        corner[other] = wp.where((edge & 2) == 0, half[other], -half[other])
                        if (
                            corner[one] * out[one] > FLAT * half[one]
                            or corner[other] * out[other] > FLAT * half[other]
                        ):
                            continue
                        start = center + turn @ corner
                        s, t = closest_of_segments(start, 2.0 * half[axis] * along, a, to_end)
                        point, ridge = start + 2.0 * s * half[axis] * along, a + t * to_end
                        distance = wp.dot(point - ridge, normal)
                        inside = wp.transpose(turn) @ (ridge - center)
                        beyond = wp.max(wp.abs(inside[0]) - half[0], wp.abs(inside[1]) - half[1])
                        beyond = wp.max(beyond, wp.abs(inside[2]) - half[2])
                        crosses = s > 0.0 and s < 1.0 and t > 0.0 and t < 1.0
                        if (
                            crosses
                            and wp.length(normal) > 0.5
                            and beyond <= margin + PEAK
                            and distance < margin
                        ):
                            touches = add_touch(touches, distance, point, normal)
    return touches


@wp.kernel(module="unique", enable_backward=False)
def height_field_contacts(c: Collisions):
    """Append the contacts of one pair (height field, geom) in one world, at most four."""
    world, pair = wp.tid()
    ground, geom = c.pairs[pair][0], c.pairs[pair][1]
    patch = c.geom_dataid[world % c.geom_dataid.shape[0], ground]
    size = c.hfield_size[patch]
    field_turn = c.geom_xmat[world, ground]
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
    reach = margin + gap
    if center[2] - bound > size[2] + reach:
        return
    if wp.abs(center[0]) - bound > size[0] or wp.abs(center[1]) - bound > size[1]:
        return

    field = Field()
    field.address = c.hfield_adr[patch]
    field.rows = c.hfield_nrow[patch]
    field.columns = c.hfield_ncol[patch]
    field.half_x = size[0]
    field.half_y = size[1]
    field.top = size[2]
    field.dx = 2.0 * size[0] / float(field.columns - 1)
    field.dy = 2.0 * size[1] / float(field.rows - 1)
    shape = c.geom_size[world % c.geom_size.shape[0], geom]
    turn = wp.transpose(field_turn) @ c.geom_xmat[world, geom]
    touches = Touches()
    if c.geom_type[geom] == SPHERE:
        touches = ball_touches(touches, field, c.hfield_data, center, shape[0], reach, 3)
    elif c.geom_type[geom] == CAPSULE:
        axis = shape[1] * wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
        touches = capsule_touches(field, c.hfield_data, center, axis, shape[0], reach)
    else:
        touches = box_touches(field, c.hfield_data, center, turn, shape, reach)

    for i in range(touches.count):
        distance = touches.distance[i]
        normal = field_turn @ touches.normal[i]
        place = field_turn @ touches.place[i] + c.geom_xpos[world, ground]
        write_contact(
            c.naconmax,
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


def take_over_height_fields(warp_model: mjw.Model) -> Callable[[mjw.Model, mjw.Data], None] | None:
    """Take the pairs of height fields with spheres, capsules and boxes away from MuJoCo Warp, in place.

    Returns what appends their contacts instead after its collision pass, or None where there are no such pairs. Pairs
    with other geoms (cylinders, ellipsoids, meshes), and pairs that a distance sensor measures, stay with MuJoCo Warp.
    """
    geom_type = warp_model.geom_type.numpy()
    pairs, pair_ids = upstream.geom_pairs(warp_model)
    types = geom_type[pairs]
    height_first = np.where(types[:, :1] == HEIGHT_FIELD, pairs, pairs[:, ::-1])
    taken = (types == HEIGHT_FIELD).any(-1) & np.isin(geom_type[height_first[:, 1]], (SPHERE, CAPSULE, BOX))
    taken &= (pair_ids[:, 0] > upstream.NO_CONTACT) & (pair_ids[:, 1] == upstream.NO_SENSOR)
    if not taken.any() or warp_model.flg_surfacevel:
        return None
    upstream.drop_contacts(warp_model, taken)
    own = {
        "pairs": wp.array(height_first[taken], dtype=wp.vec2i),
        "pair_ids": wp.array(pair_ids[taken], dtype=wp.vec2i),
    }

    def append(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        collisions = filled(Collisions, own, warp_model, warp_data_E)
        wp.launch(height_field_contacts, dim=(warp_data_E.nworld, int(taken.sum())), inputs=[collisions])

    return append
