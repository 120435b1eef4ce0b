"""These Warp functions know the corners and edges of boxes, and the closest places of segments and triangles."""

# Kernels are Python only in their spelling, and a number that a loop changes has to be made a variable by its type.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportAttributeAccessIssue=false, reportReturnType=false, reportInvalidTypeForm=false

import warp as wp

TINY = wp.constant(1.0e-9)


@wp.func
def corner_of(corner: int, half: wp.vec3) -> wp.vec3:
    """Return one of the 8 corners of a box."""
    return wp.vec3(
        # Bits of the number are the signs along x, y and z.
        wp.where((corner & 1) == 0, -half[0], half[0]),
        wp.where((corner & 2) == 0, -half[1], half[1]),
        wp.where((corner & 4) == 0, -half[2], half[2]),
    )


@wp.func
def start_of_edge(edge: int, half: wp.vec3) -> wp.vec3:
    """Return where one of the 12 edges of a box begins; it runs along the axis `edge // 4`."""
    axis = edge // 4
    start = wp.vec3()
    start[axis] = -half[axis]
    one = (axis + 1) % 3
    other = (axis + 2) % 3
    # The two axes across the edge: bits of its number are the signs.
    start[one] = wp.where((edge & 1) == 0, -half[one], half[one])
    start[other] = wp.where((edge & 2) == 0, -half[other], half[other])
    return start


@wp.func
def along_edge(edge: int, half: wp.vec3) -> wp.vec3:
    """Return the vector from the beginning of an edge to its end."""
    along = wp.vec3()
    along[edge // 4] = 2.0 * half[edge // 4]
    return along


@wp.func
def closest_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Return the closest point of a triangle (Ericson, "Real-Time Collision Detection", 2005, 5.1.5)."""
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    # Beyond corner a, then b, then along edge ab, and so on: the regions around a triangle.
    if d1 <= 0.0 and d2 <= 0.0:
        return a
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return a + ab * (d1 / (d1 - d3))
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return a + ac * (d2 / (d2 - d6))
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
    # Inside of the triangle, by barycentric coordinates.
    scale = 1.0 / (va + vb + vc)
    return a + ab * (vb * scale) + ac * (vc * scale)


@wp.func
def closest_of_segments(p: wp.vec3, d1: wp.vec3, q: wp.vec3, d2: wp.vec3):
    """Return the parameters in [0, 1] of the closest points of p + s d1 and q + t d2 (Ericson 2005, 5.1.9)."""
    r = p - q
    a = wp.dot(d1, d1)
    e = wp.dot(d2, d2)
    f = wp.dot(d2, r)
    b = wp.dot(d1, d2)
    c = wp.dot(d1, r)
    denominator = a * e - b * b
    s = float(0.5)  # noqa: UP018 (Warp: a variable that changes)
    # Segments that are not parallel; of parallel ones, any point will do, such as the middle.
    if denominator > TINY * a * e:
        s = wp.clamp((b * f - c * e) / denominator, 0.0, 1.0)
    t = (b * s + f) / e
    # The parameter on the second segment is clamped, and the first one's follows from it.
    if t < 0.0:
        t = 0.0
        s = wp.clamp(-c / a, 0.0, 1.0)
    elif t > 1.0:
        t = 1.0
        s = wp.clamp((b - c) / a, 0.0, 1.0)
    return s, t
