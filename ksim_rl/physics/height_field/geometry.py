"""These Warp functions find how far a point is from the ground of a height field, and where its ridges are.

The ground is what is below the triangles, however deep, and ends at the field's edges. A point above it is closest to
a point of the triangles; a point below it finds out along the normal of the triangle right above it, so that nothing
tunnels. All places are in the field's own frame, m.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for, and a number that a loop
# changes has to be made a variable by its type.
# ruff: noqa: UP018
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false

import warp as wp

FAR = wp.constant(1.0e10)
TINY = wp.constant(1.0e-9)
# Contacts of one ball whose normals are closer than about 18 degrees are one contact: neighbouring triangles of a
# nearly even ground all come close to it.
SAME_NORMAL = wp.constant(0.95)
# The cosine from which on a point is said to be straight above a face.
STRAIGHT = wp.constant(0.9999)
# The sine below which a ridge and an edge of a box are parallel, and have no point in common.
PARALLEL = wp.constant(1.0e-2)
# How much a point or an edge of the ground has to stand out above its neighbours to be a peak or a ridge, m.
PEAK = wp.constant(1.0e-4)


@wp.struct
class Field:
    """One height field in its own frame: its lattice, and where its data begin."""

    address: int
    rows: int
    columns: int
    half_x: float
    half_y: float
    top: float
    dx: float
    dy: float


@wp.struct
class Touch:
    """The closest place of the ground to a point: signed distance, negative below it, and the way out."""

    distance: float
    normal: wp.vec3


@wp.func
def field_point(field: Field, data: wp.array[float], row: int, column: int) -> wp.vec3:
    """Return a point of the lattice."""
    return wp.vec3(
        float(column) * field.dx - field.half_x,
        float(row) * field.dy - field.half_y,
        data[field.address + row * field.columns + column] * field.top,
    )


@wp.func
def face_normal(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Return the normal of a triangle that points up."""
    normal = wp.normalize(wp.cross(b - a, c - a))
    return wp.where(normal[2] < 0.0, -normal, normal)


@wp.func
def is_over(field: Field, point: wp.vec3) -> bool:
    """Return whether a point is above or below the field, within its edges."""
    return wp.abs(point[0]) <= field.half_x and wp.abs(point[1]) <= field.half_y


@wp.func
def ground_at(field: Field, data: wp.array[float], point: wp.vec3) -> Touch:
    """Return the distance of a point to the plane of the triangle right above or below it."""
    x, y = (point[0] + field.half_x) / field.dx, (point[1] + field.half_y) / field.dy
    column = wp.clamp(int(wp.floor(x)), 0, field.columns - 2)
    row = wp.clamp(int(wp.floor(y)), 0, field.rows - 2)
    a = field_point(field, data, row, column)
    b = field_point(field, data, row + 1, column)
    if x - float(column) >= y - float(row):
        b = field_point(field, data, row, column + 1)
    touch = Touch()
    touch.normal = face_normal(a, b, field_point(field, data, row + 1, column + 1))
    touch.distance = wp.dot(point - a, touch.normal)
    return touch


@wp.func
def closest_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Return the closest point of a triangle (Ericson, "Real-Time Collision Detection", 2005, 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = wp.dot(ab, ap), wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return a
    bp = p - b
    d3, d4 = wp.dot(ab, bp), wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return a + ab * (d1 / (d1 - d3))
    cp = p - c
    d5, d6 = wp.dot(ab, cp), wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return a + ac * (d2 / (d2 - d6))
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
    scale = 1.0 / (va + vb + vc)
    return a + ab * (vb * scale) + ac * (vc * scale)


@wp.func
def closest_of_segments(p: wp.vec3, d1: wp.vec3, q: wp.vec3, d2: wp.vec3):
    """Return the parameters in [0, 1] of the closest points of p + s d1 and q + t d2 (Ericson 2005, 5.1.9)."""
    r = p - q
    a, e, f = wp.dot(d1, d1), wp.dot(d2, d2), wp.dot(d2, r)
    b, c = wp.dot(d1, d2), wp.dot(d1, r)
    denominator = a * e - b * b
    s = float(0.5)
    if denominator > TINY * a * e:
        s = wp.clamp((b * f - c * e) / denominator, 0.0, 1.0)
    t = (b * s + f) / e
    if t < 0.0:
        t = 0.0
        s = wp.clamp(-c / a, 0.0, 1.0)
    elif t > 1.0:
        t = 1.0
        s = wp.clamp((b - c) / a, 0.0, 1.0)
    return s, t


@wp.func
def closest_ground(
    field: Field,
    data: wp.array[float],
    point: wp.vec3,
    reach: float,
    found: int,
    first: wp.vec3,
    second: wp.vec3,
) -> Touch:
    """Return the closest place of the ground to a point above it, within `reach`; the distance is `FAR` if none.

    After `found` contacts with normals `first` and `second`, only faces with other normals count, and only where the
    point is straight above them.
    """
    touch = Touch()
    touch.distance = FAR
    low_column = wp.max(int(wp.floor((point[0] - reach + field.half_x) / field.dx)), 0)
    low_row = wp.max(int(wp.floor((point[1] - reach + field.half_y) / field.dy)), 0)
    high_column = wp.min(int(wp.floor((point[0] + reach + field.half_x) / field.dx)), field.columns - 2)
    high_row = wp.min(int(wp.floor((point[1] + reach + field.half_y) / field.dy)), field.rows - 2)
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            a = field_point(field, data, row, column)
            c = field_point(field, data, row + 1, column + 1)
            for half in range(2):
                b = field_point(field, data, row + half, column + 1 - half)
                if wp.max(wp.max(a[2], b[2]), c[2]) < point[2] - reach:
                    continue
                away = point - closest_on_triangle(point, a, b, c)
                distance = wp.length(away)
                if distance > reach or distance >= touch.distance:
                    continue
                normal = face_normal(a, b, c)
                lift = wp.dot(away, normal)
                if lift < 0.0:
                    continue
                # Else the closest point is on an edge or a corner.
                is_face = lift >= STRAIGHT * distance
                if not is_face:
                    normal = away / distance
                if found > 0 and (not is_face or wp.dot(normal, first) > SAME_NORMAL):
                    continue
                if found > 1 and wp.dot(normal, second) > SAME_NORMAL:
                    continue
                touch.distance = distance
                touch.normal = normal
    return touch


@wp.func
def is_ridge(field: Field, data: wp.array[float], row: int, column: int, kind: int) -> bool:
    """Return whether the ground falls off from an edge of a cell on both sides, rather than being even or a valley.

    The edges that a cell owns start at its first corner: 0 runs along x, 1 along y, 2 is the diagonal.
    """
    a = field_point(field, data, row, column)
    c = field_point(field, data, row + 1, column + 1)
    b = field_point(field, data, row, column + 1)
    d = field_point(field, data, row + 1, column)
    if kind == 2:
        return wp.dot(face_normal(a, b, c), d - a) < -PEAK
    if kind == 0:
        if row == 0:
            return False
        return wp.dot(face_normal(a, b, c), field_point(field, data, row - 1, column) - a) < -PEAK
    if column == 0:
        return False
    return wp.dot(face_normal(a, d, c), field_point(field, data, row, column - 1) - a) < -PEAK


@wp.func
def ridge_normal(
    field: Field, data: wp.array[float], row: int, column: int, kind: int, direction: wp.vec3
) -> wp.vec3:
    """Return the upward normal of the plane through a ridge and along a direction; zero where the plane cuts ground."""
    a = field_point(field, data, row, column)
    end = field_point(field, data, row + wp.where(kind == 0, 0, 1), column + wp.where(kind == 1, 0, 1))
    # What the triangles on both sides have besides the ridge.
    left = field_point(
        field, data, row + wp.where(kind == 0, -1, 0), column + wp.where(kind == 1, -1, kind // 2)
    )
    right = field_point(field, data, row + 1, column + wp.where(kind == 2, 0, 1))
    normal = wp.cross(end - a, direction)
    if wp.length(normal) < PARALLEL * wp.length(end - a):
        return wp.vec3(0.0)
    normal = wp.normalize(normal)
    normal = wp.where(normal[2] < 0.0, -normal, normal)
    if wp.dot(normal, left - a) > PEAK or wp.dot(normal, right - a) > PEAK:
        return wp.vec3(0.0)
    return normal


@wp.func
def closest_ridge(field: Field, data: wp.array[float], start: wp.vec3, along: wp.vec3, reach: float):
    """Return distance, parameter on the segment and normal of the ridge that is closest to the inside of a segment."""
    best, parameter, normal = float(FAR), float(0.0), wp.vec3(0.0, 0.0, 1.0)
    stop = start + along
    low_x, high_x = wp.min(start[0], stop[0]) - reach, wp.max(start[0], stop[0]) + reach
    low_y, high_y = wp.min(start[1], stop[1]) - reach, wp.max(start[1], stop[1]) + reach
    lowest = wp.min(start[2], stop[2]) - reach
    low_column = wp.max(int(wp.floor((low_x + field.half_x) / field.dx)), 0)
    low_row = wp.max(int(wp.floor((low_y + field.half_y) / field.dy)), 0)
    high_column = wp.min(int(wp.floor((high_x + field.half_x) / field.dx)), field.columns - 2)
    high_row = wp.min(int(wp.floor((high_y + field.half_y) / field.dy)), field.rows - 2)
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            a = field_point(field, data, row, column)
            for kind in range(3):
                end = field_point(
                    field, data, row + wp.where(kind == 0, 0, 1), column + wp.where(kind == 1, 0, 1)
                )
                if wp.max(a[2], end[2]) < lowest:
                    continue
                s, t = closest_of_segments(start, along, a, end - a)
                if s <= 0.0 or s >= 1.0:
                    continue
                away = start + s * along - (a + t * (end - a))
                distance = wp.length(away)
                if distance > reach or distance >= best or distance < TINY or away[2] < 0.0:
                    continue
                if is_ridge(field, data, row, column, kind):
                    best, parameter, normal = distance, s, away / distance
    return best, parameter, normal
