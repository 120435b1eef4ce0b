"""Measures how far boxes are apart, or how deep in each other, for the sensors of distances.

MuJoCo Warp finds that by GJK, but only for models whose boxes collide by GJK as well, and so otherwise than in C
(`upstream.collide_boxes_exactly`). Where boxes collide as in C, it measures nothing beyond their margin.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false

from collections.abc import Callable

import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics import upstream
from ksim_rl.physics.shapes import along_edge, closest_of_segments, corner_of, start_of_edge
from ksim_rl.physics.structs import filled, struct_with
from ksim_rl.physics.upstream import make_frame, vec5, write_contact

BOX = int(mjw.GeomType.BOX)
SENSOR = int(upstream.ContactType.SENSOR)
NO_CONTACT = upstream.NO_CONTACT
FAR = wp.constant(1.0e10)
# Below this gap, m, the direction from one closest point to the other is rounding of float32.
TOUCHING = wp.constant(1.0e-5)
# The sine below which two edges are parallel, and have no common normal.
PARALLEL = wp.constant(1.0e-6)
# The normals of three faces of each box, and what is normal to an edge of each.
AXES = wp.constant(15)
EDGE_PAIRS = wp.constant(144)


@wp.struct
class Gap:
    """The gap between two boxes, in the first one's frame: a place on each, and the distance between them."""

    distance: float
    own: wp.vec3
    other: wp.vec3


@wp.struct
class Overlap:
    """The direction from the first box to the second in which they are the farthest apart, or the least deep."""

    distance: float
    normal: wp.vec3


@struct_with(
    ("", mjw.Model, "geom_type geom_size"),
    ("", mjw.Data, "geom_xpos geom_xmat naconmax nacon"),
    (
        "contact_",
        mjw.Contact,
        "dist pos frame includemargin friction solref solreffriction solimp dim geom efc_address worldid type "
        "geomcollisionid adhesion",
    ),
)
class Measured:
    """The pairs of boxes that sensors measure, and the contacts through which the sensors read them."""

    pairs: wp.array[wp.vec2i]


@wp.func
def nearer(gap: Gap, own: wp.vec3, other: wp.vec3) -> Gap:
    """Return the gap between two places if it is the narrower one."""
    distance = wp.length(other - own)
    if distance < gap.distance:
        gap.distance = distance
        gap.own = own
        gap.other = other
    return gap


@wp.func
def gap_between(half: wp.vec3, other_half: wp.vec3, turn: wp.mat33, place: wp.vec3) -> Gap:
    """Return the gap between boxes that are not in each other: at a corner of either, or between two edges."""
    gap = Gap()
    gap.distance = FAR
    back = wp.transpose(turn)
    # Each corner of either box against the other, where clamping in its frame finds the closest place.
    for corner in range(8):
        point = place + turn @ corner_of(corner, other_half)
        gap = nearer(gap, wp.max(wp.min(point, half), -half), point)
        own = corner_of(corner, half)
        inside = back @ (own - place)
        gap = nearer(gap, own, place + turn @ wp.max(wp.min(inside, other_half), -other_half))
    # Each edge of one box against each of the other.
    for pair in range(EDGE_PAIRS):
        start = start_of_edge(pair // 12, half)
        along = along_edge(pair // 12, half)
        other_start = place + turn @ start_of_edge(pair % 12, other_half)
        other_along = turn @ along_edge(pair % 12, other_half)
        s, t = closest_of_segments(start, along, other_start, other_along)
        gap = nearer(gap, start + s * along, other_start + t * other_along)
    return gap


@wp.func
def overlap_of(half: wp.vec3, other_half: wp.vec3, turn: wp.mat33, place: wp.vec3) -> Overlap:
    """Return the best of the 15 axes that can separate two boxes (Gottschalk et al., "OBBTree", 1996)."""
    best = Overlap()
    best.distance = -FAR
    # Axes 0 to 2 are the first box's, 3 to 5 the second's, the others cross products of one edge of each.
    for axis in range(AXES):
        normal = wp.vec3()
        if axis < 3:
            normal[axis] = 1.0
        elif axis < 6:
            normal = wp.vec3(turn[0, axis - 3], turn[1, axis - 3], turn[2, axis - 3])
        else:
            edge = wp.vec3()
            other = (axis - 6) % 3
            edge[(axis - 6) // 3] = 1.0
            normal = wp.cross(edge, wp.vec3(turn[0, other], turn[1, other], turn[2, other]))
        length = wp.length(normal)
        # Parallel edges have no common normal, and the normals of the faces cover that case.
        if length > PARALLEL:
            normal = normal / length
            # Half the extents of both boxes along the axis, then the distance between their centres.
            reach = wp.dot(wp.abs(normal), half) + wp.dot(
                wp.abs(wp.transpose(turn) @ normal), other_half
            )
            offset = wp.dot(normal, place)
            distance = wp.abs(offset) - reach
            if distance > best.distance:
                best.distance = distance
                best.normal = wp.where(offset < 0.0, -normal, normal)
    return best


@wp.kernel(module="unique", enable_backward=False)
def forget_touching_boxes(c: Measured):
    """Hide contacts of touching boxes from sensors: the collision pass finds another depth than the least."""
    contact = wp.tid()
    # The pool has a place for each thread; the first `nacon` are in use.
    if contact >= c.nacon[0]:
        return
    # Geoms of a contact are -1 where flexes touch.
    first = c.contact_geom[contact][0]
    second = c.contact_geom[contact][1]
    if first < 0 or second < 0 or c.geom_type[first] != BOX or c.geom_type[second] != BOX:
        return
    c.contact_type[contact] = c.contact_type[contact] & ~SENSOR


@wp.kernel(module="unique", enable_backward=False)
def measure_boxes(c: Measured):
    """Append a contact for each measured pair and world, which has no rows: the closest places of the two boxes."""
    world, pair = wp.tid()
    first = c.pairs[pair][0]
    second = c.pairs[pair][1]
    row = world % c.geom_size.shape[0]
    half = c.geom_size[row, first]
    other_half = c.geom_size[row, second]
    frame = c.geom_xmat[world, first]
    back = wp.transpose(frame)
    turn = back @ c.geom_xmat[world, second]
    place = back @ (c.geom_xpos[world, second] - c.geom_xpos[world, first])
    overlap = overlap_of(half, other_half, turn, place)
    normal = overlap.normal
    # Boxes that are in each other are drawn apart until they touch, which tells where.
    moved = wp.max(-overlap.distance, 0.0) * normal
    gap = gap_between(half, other_half, turn, place + moved)
    distance = gap.distance
    if overlap.distance < 0.0:
        distance = overlap.distance
    elif distance > TOUCHING:
        normal = (gap.other - gap.own) / distance
    middle = 0.5 * (gap.own + gap.other - moved)
    write_contact(
        c.naconmax,
        0,
        distance,
        c.geom_xpos[world, first] + frame @ middle,
        make_frame(frame @ normal),
        0.0,
        0.0,
        1,
        vec5(),
        wp.vec2(),
        wp.vec2(),
        vec5(),
        0.0,
        c.pairs[pair],
        wp.vec2i(NO_CONTACT, 0),
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


def take_over_measured_boxes(warp_model: mjw.Model) -> Callable[[mjw.Model, mjw.Data], None] | None:
    """Return a hook that appends distances of boxes after a collision pass; None where no sensor reads any."""
    pairs, pair_ids = upstream.geom_pairs(warp_model)
    are_boxes = (warp_model.geom_type.numpy()[pairs] == BOX).all(-1)
    measured = are_boxes & (pair_ids[:, 1] > upstream.NO_SENSOR)
    if not measured.any():
        return None
    own = {"pairs": wp.array(pairs[measured], dtype=wp.vec2i)}

    def append(warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        everything = filled(Measured, own, warp_model, warp_data_E)
        wp.launch(forget_touching_boxes, dim=warp_data_E.naconmax, inputs=[everything])
        wp.launch(measure_boxes, dim=(warp_data_E.nworld, int(measured.sum())), inputs=[everything])

    # Launched after the collision pass, since it clears bits that the pass has set.
    return append
