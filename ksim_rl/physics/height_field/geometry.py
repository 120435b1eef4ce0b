"""These Warp functions measure how far points and boxes are from the prisms below the triangles of a height field.

As in MuJoCo's C engine, the ground is made of a prism below each triangle, down to the field's base, and each collides
on its own (https://mujoco.readthedocs.io/en/stable/XMLreference.html#asset-hfield). A capsule is a box without width,
whose surface is its radius away. All places are in the field's own frame, m.
"""

# Kernels are Python only in their spelling, and a number that a loop changes has to be made a variable by its type.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false

import warp as wp

from ksim_rl.physics.shapes import (
    along_edge,
    closest_of_segments,
    closest_on_triangle,
    corner_of,
    start_of_edge,
)

FAR = wp.constant(1.0e10)
# Below this gap, m, the direction from one closest place to the other is rounding of float32.
TOUCHING = wp.constant(1.0e-5)
# The sine below which two edges are parallel, and have no common normal.
PARALLEL = wp.constant(1.0e-6)
# How much farther apart, m, two shapes have to be along what is normal to two edges than along the normal of a face:
# where edges lie in a face, both are the same but for rounding.
NEARLY = wp.constant(1.0e-6)
FACES = wp.constant(5)
EDGES = wp.constant(9)
CORNERS = wp.constant(6)
# Edges of a prism that differ in direction: those at the top and at the base, and one of the vertical ones.
DIRECTIONS = wp.constant(7)


@wp.struct
class Field:
    """One height field in its own frame: its lattice, and where its data begin."""

    address: int
    rows: int
    columns: int
    half_x: float
    half_y: float
    top: float
    base: float
    dx: float
    dy: float


@wp.struct
class Prism:
    """The ground below one triangle, with the outward normals of its sides and its top, which `with_normals` sets."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    base: float
    side_a: wp.vec3
    side_b: wp.vec3
    side_c: wp.vec3
    up: wp.vec3


@wp.struct
class Core:
    """The part of a geom that collides, without its radius: a box, one edge of it (capsule) or its centre (sphere).

    A capsule's edge lies along the third axis, the `first_axis` of the three that has a length.
    """

    center: wp.vec3
    turn: wp.mat33
    half: wp.vec3
    radius: float
    first_axis: int
    first_edge: int
    num_edges: int
    corner_step: int


@wp.struct
class Touch:
    """How far a geom is from a prism, negative inside, the way out, and the place half-way between the surfaces."""

    distance: float
    normal: wp.vec3
    place: wp.vec3


@wp.struct
class Gap:
    """The gap between a prism and a core that are apart: a place on each, and their distance."""

    distance: float
    ground: wp.vec3
    place: wp.vec3


@wp.func
def field_of(size: wp.vec4, rows: int, columns: int, address: int) -> Field:
    """Return a field of some rows and columns, whose size is as in a model and whose data begin at an address."""
    field = Field()
    field.address = address
    field.rows = rows
    field.columns = columns
    field.half_x = size[0]
    field.half_y = size[1]
    field.top = size[2]
    field.base = size[3]
    # Spacing of the lattice, m: n points have n - 1 cells between them.
    field.dx = 2.0 * size[0] / float(columns - 1)
    field.dy = 2.0 * size[1] / float(rows - 1)
    return field


@wp.func
def field_point(field: Field, data: wp.array[float], row: int, column: int) -> wp.vec3:
    """Return a point of the lattice."""
    return wp.vec3(
        float(column) * field.dx - field.half_x,
        float(row) * field.dy - field.half_y,
        # Heights are stored from 0 to 1; `top` scales them to m.
        data[field.address + row * field.columns + column] * field.top,
    )


@wp.func
def prism_of(field: Field, data: wp.array[float], row: int, column: int, half: int) -> Prism:
    """Return the first or second prism of a cell."""
    prism = Prism()
    # The diagonal a-c is common to both triangles of a cell; `half` picks the corner beside it.
    prism.a = field_point(field, data, row, column)
    prism.b = field_point(field, data, row + 1 - half, column + half)
    prism.c = field_point(field, data, row + 1, column + 1)
    prism.base = -field.base
    return prism


@wp.func
def corner_of_prism(prism: Prism, corner: int) -> wp.vec3:
    """Return one of three corners at the top, or below them at the base."""
    # Corners 3 to 5 lie straight below 0 to 2.
    which = corner % 3
    point = wp.where(which == 0, prism.a, wp.where(which == 1, prism.b, prism.c))
    if corner >= 3:
        point[2] = prism.base
    return point


@wp.func
def start_and_end(prism: Prism, edge: int):
    """Return the ends of an edge: three at the top, three at the base, and three between them."""
    # Edges 0 to 2 are at the top, 3 to 5 at the base.
    if edge < 6:
        level = 3 * (edge // 3)
        return corner_of_prism(prism, level + edge % 3), corner_of_prism(
            prism, level + (edge + 1) % 3
        )
    # Edges 6 to 8 are vertical, from the base up.
    return corner_of_prism(prism, edge - 3), corner_of_prism(prism, edge - 6)


@wp.func
def outward(start: wp.vec3, end: wp.vec3, inside: wp.vec3) -> wp.vec3:
    """Return the normal of a side between two corners that points away from the third."""
    # Sides are vertical: their normals are horizontal, and only the sign depends on the sense.
    along = end - start
    normal = wp.normalize(wp.vec3(along[1], -along[0], 0.0))
    return wp.where(wp.dot(normal, inside - start) > 0.0, -normal, normal)


@wp.func
def with_normals(prism: Prism) -> Prism:
    """Return a prism with its normals."""
    prism.side_a = outward(prism.a, prism.b, prism.c)
    prism.side_b = outward(prism.b, prism.c, prism.a)
    prism.side_c = outward(prism.c, prism.a, prism.b)
    # The two triangles of a cell turn in opposite senses, so that the sign is chosen by its z.
    up = wp.normalize(wp.cross(prism.b - prism.a, prism.c - prism.a))
    prism.up = wp.where(up[2] < 0.0, -up, up)
    return prism


@wp.func
def normal_of_face(prism: Prism, face: int) -> wp.vec3:
    """Return the outward normal of a face: three at the sides, then top and base."""
    if face == 4:
        return wp.vec3(0.0, 0.0, -1.0)
    if face == 3:
        return prism.up
    return wp.where(face == 0, prism.side_a, wp.where(face == 1, prism.side_b, prism.side_c))


@wp.func
def point_of_face(prism: Prism, face: int) -> wp.vec3:
    """Return a corner of a face."""
    if face == 4:
        return corner_of_prism(prism, 3)
    return corner_of_prism(prism, face % 3)


@wp.func
def closest_on_face(prism: Prism, face: int, point: wp.vec3) -> wp.vec3:
    """Return the closest place of a face to a point."""
    # Top and base are triangles.
    if face >= 3:
        level = 3 * (face - 3)
        return closest_on_triangle(
            point,
            corner_of_prism(prism, level),
            corner_of_prism(prism, level + 1),
            corner_of_prism(prism, level + 2),
        )
    # A side is a quadrilateral, tested as two triangles.
    start = corner_of_prism(prism, face)
    end = corner_of_prism(prism, (face + 1) % 3)
    below = corner_of_prism(prism, 3 + (face + 1) % 3)
    place = closest_on_triangle(point, start, end, below)
    other = closest_on_triangle(point, start, corner_of_prism(prism, 3 + face), below)
    return wp.where(wp.length(other - point) < wp.length(place - point), other, place)


@wp.func
def touch_of_point(prism: Prism, point: wp.vec3, most: float) -> Touch:
    """Return how far a point is from a prism, and the closest place of its surface.

    Beyond a distance of `most` it is enough to know that: the search ends with a face that is so far below the point.
    """
    # Inside of all faces, the face least deep is the way out.
    touch = Touch()
    touch.distance = -FAR
    for face in range(FACES):
        normal = normal_of_face(prism, face)
        height = wp.dot(normal, point - point_of_face(prism, face))
        if height > touch.distance:
            touch.distance = height
            touch.normal = normal
    # The foot of the perpendicular is on the face itself only for points inside; others continue below.
    touch.place = point - touch.distance * touch.normal
    if touch.distance <= 0.0 or touch.distance >= most:
        return touch
    # The closest place of a convex shape is on a face that looks towards the point.
    axis = touch.normal
    touch.distance = FAR
    for face in range(FACES):
        normal = normal_of_face(prism, face)
        if wp.dot(normal, point - point_of_face(prism, face)) > 0.0:
            place = closest_on_face(prism, face, point)
            distance = wp.length(point - place)
            if distance < touch.distance:
                touch.distance = distance
                touch.place = place
    # On the surface, the direction to the closest place is noise: the face's normal holds.
    touch.normal = axis
    if touch.distance > TOUCHING:
        touch.normal = (point - touch.place) / touch.distance
    return touch


@wp.func
def nearer(gap: Gap, ground: wp.vec3, place: wp.vec3) -> Gap:
    """Return the gap between two places if it is the narrower one."""
    distance = wp.length(place - ground)
    if distance < gap.distance:
        gap.distance = distance
        gap.ground = ground
        gap.place = place
    return gap


@wp.func
def gap_between(prism: Prism, core: Core) -> Gap:
    """Return the gap between a prism and a core that are not in each other: at corners of either, or at edges."""
    # All pairs of features of two convex bodies: corners with faces, corners with the box, edges with edges.
    gap = Gap()
    gap.distance = FAR
    # Corners of the core against the prism; a step of 8 leaves one for a core that is a point.
    for corner in range(0, 8, core.corner_step):
        point = core.center + core.turn @ corner_of(corner, core.half)
        touch = touch_of_point(prism, point, FAR)
        # A corner in the prism has no gap.
        gap = nearer(gap, wp.where(touch.distance > 0.0, touch.place, point), point)
    # Corners of the prism against the core, if it is more than an edge.
    if core.num_edges > 1:
        for corner in range(CORNERS):
            ground = corner_of_prism(prism, corner)
            # In the frame of the box, the closest place is found by clamping.
            inside = wp.transpose(core.turn) @ (ground - core.center)
            place = core.center + core.turn @ wp.max(wp.min(inside, core.half), -core.half)
            gap = nearer(gap, ground, place)
    # Edges against edges.
    for edge in range(core.first_edge, core.first_edge + core.num_edges):
        start = core.center + core.turn @ start_of_edge(edge, core.half)
        along = core.turn @ along_edge(edge, core.half)
        for other in range(EDGES):
            ground, end = start_and_end(prism, other)
            s, t = closest_of_segments(start, along, ground, end - ground)
            gap = nearer(gap, ground + t * (end - ground), start + s * along)
    return gap


@wp.func
def column_of(turn: wp.mat33, column: int) -> wp.vec3:
    """Return a column of a matrix."""
    return wp.vec3(turn[0, column], turn[1, column], turn[2, column])


@wp.func
def projected(normal: wp.vec3, corner: wp.vec3, base: float) -> wp.vec2:
    """Return the least and the largest projection of a corner of a prism and of the point at the base below it."""
    flat = normal[0] * corner[0] + normal[1] * corner[1]
    top = flat + normal[2] * corner[2]
    below = flat + normal[2] * base
    return wp.vec2(wp.min(top, below), wp.max(top, below))


@wp.func
def wider(best: Touch, prism: Prism, core: Core, normal: wp.vec3, margin: float) -> Touch:
    """Return a direction as the widest if prism and core are farther apart along it, by more than the margin."""
    at_a = projected(normal, prism.a, prism.base)
    at_b = projected(normal, prism.b, prism.base)
    at_c = projected(normal, prism.c, prism.base)
    low = wp.min(wp.min(at_a[0], at_b[0]), at_c[0])
    high = wp.max(wp.max(at_a[1], at_b[1]), at_c[1])
    middle = wp.dot(normal, core.center)
    reach = wp.dot(wp.abs(wp.transpose(core.turn) @ normal), core.half)
    # The signed distance in both senses of the axis.
    above = middle - reach - high
    below = low - middle - reach
    if wp.max(above, below) > best.distance + margin:
        best.distance = wp.max(above, below)
        best.normal = wp.where(above >= below, normal, -normal)
    return best


@wp.func
def widest_axis(prism: Prism, core: Core, enough: float) -> Touch:
    """Return the direction along which prism and core are the farthest apart, or the least deep in each other.

    The search ends with the first direction along which they are as far apart as is `enough` to leave the prism out.
    """
    # The separating axis theorem: convex bodies are apart where the projections on one of the axes are.
    best = Touch()
    best.distance = -FAR
    for face in range(FACES):
        best = wider(best, prism, core, normal_of_face(prism, face), 0.0)
        if best.distance >= enough:
            return best
    # One edge alone has no faces.
    if core.num_edges > 1:
        for axis in range(3):
            best = wider(best, prism, core, column_of(core.turn, axis), 0.0)
            if best.distance >= enough:
                return best
    # Cross products of each edge of the prism with each edge of the core.
    for edge in range(DIRECTIONS):
        start, end = start_and_end(prism, edge)
        along = wp.normalize(end - start)
        for axis in range(core.first_axis, 3):
            normal = wp.cross(along, column_of(core.turn, axis))
            length = wp.length(normal)
            # Parallel edges have no common normal, and the faces' normals cover them.
            if length > PARALLEL:
                # Between equal axes, a face's normal wins over the rounding of a cross product.
                best = wider(best, prism, core, normal / length, NEARLY)
                if best.distance >= enough:
                    return best
    return best


@wp.func
def touch_of_core(prism: Prism, core: Core, reach: float) -> Touch:
    """Return how far a geom is from a prism; the distance is `FAR` where it is beyond `reach`."""
    touch = Touch()
    # A sphere is a point with a radius.
    if core.num_edges == 0:
        touch = touch_of_point(prism, core.center, reach + core.radius)
        touch.distance = touch.distance - core.radius
        touch.place = touch.place + 0.5 * touch.distance * touch.normal
        return touch
    widest = widest_axis(prism, core, reach + core.radius)
    touch.distance = FAR
    # Most prisms below a geom are out of reach: their closest places are never computed.
    if widest.distance - core.radius >= reach:
        return touch
    # Shapes that are in each other are drawn apart until they touch, which tells where.
    moved = wp.max(-widest.distance, 0.0) * widest.normal
    apart = core
    apart.center = core.center + moved
    gap = gap_between(prism, apart)
    touch.normal = widest.normal
    distance = gap.distance
    # In each other, the depth along that axis counts; apart, the distance between the closest places.
    if widest.distance < 0.0:
        distance = widest.distance
    elif distance > TOUCHING:
        touch.normal = (gap.place - gap.ground) / distance
    touch.distance = distance - core.radius
    # On the surface of the geom, then half-way to the ground.
    touch.place = gap.place - moved - (core.radius + 0.5 * touch.distance) * touch.normal
    return touch
