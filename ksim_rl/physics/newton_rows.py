"""The cost of one constraint, its force, and both along a search direction.

`x` is the residual J qacc - aref of a row, `v` its rate J search, `d` its stiffness D. A point on the search direction
is (cost minus the cost at its start, slope, curvature); differences of costs are formed term by term, since the costs
themselves agree in most of their digits. Formulas: https://mujoco.readthedocs.io/en/stable/computation/index.html
(constraint solver).
"""

# Kernels are Python only in their spelling.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false, reportInvalidTypeForm=false
# Warp: a variable that changes in a loop is float(0.0).
# ruff: noqa: UP018

import mujoco
import warp as wp

MINVAL = wp.constant(float(mujoco.mjMINVAL))

# Kinds of rows. A friction cone is evaluated by its head, the row of the normal; its tangents are passed over.
EQUALITY = wp.constant(0)
FRICTION = wp.constant(1)
ONE_SIDED = wp.constant(2)
CONE_HEAD = wp.constant(3)
CONE_TANGENT = wp.constant(4)

# Zones of a row.
SATISFIED = wp.constant(int(mujoco.mjtConstraintState.mjCNSTRSTATE_SATISFIED))
QUADRATIC = wp.constant(int(mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC))
LINEAR_NEGATIVE = wp.constant(int(mujoco.mjtConstraintState.mjCNSTRSTATE_LINEARNEG))
LINEAR_POSITIVE = wp.constant(int(mujoco.mjtConstraintState.mjCNSTRSTATE_LINEARPOS))
CONE = wp.constant(int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE))

# What a cone is along a search direction: floats per cone, which has at least three rows of four.
FLOATS_PER_ROW = 4
(_MU, _U0, _V0, _ALONG, _SPEED, _ASIDE2, _DM, _COST, _SLOPE, _HALF_CURVATURE, _T0, _ZONE0) = map(
    wp.constant, range(12)
)


@wp.func
def ratio(x: float, y: float) -> float:
    """Divide, by a tiny number instead of zero."""
    if y == 0.0:
        return x / MINVAL
    return x / y


@wp.func
def one_sided_start(x: float, v: float, d: float) -> wp.vec3:
    """Return cost, slope and curvature of a limit or contact row at the start of the direction."""
    if x >= 0.0:
        return wp.vec3(0.0)
    return wp.vec3(0.5 * d * x * x, d * v * x, d * v * v)


@wp.func
def one_sided_point(x: float, v: float, d: float, alpha: float) -> wp.vec3:
    """Return the point at `alpha` of a limit or contact row."""
    before = 0.5 * d * x * x
    if x + alpha * v >= 0.0:
        return wp.vec3(wp.where(x < 0.0, -before, 0.0), 0.0, 0.0)
    slope, curvature = d * v * x, d * v * v
    change = alpha * (slope + 0.5 * alpha * curvature)
    return wp.vec3(wp.where(x < 0.0, change, change + before), slope + alpha * curvature, curvature)


@wp.func
def friction_value(x: float, v: float, d: float, limit: float) -> wp.vec3:
    """Return cost, slope and curvature of a dry-friction row, which is linear beyond `limit` / `d`."""
    reach = ratio(limit, d)
    if x <= -reach:
        return wp.vec3(limit * (-0.5 * reach - x), -limit * v, 0.0)
    if x >= reach:
        return wp.vec3(limit * (-0.5 * reach + x), limit * v, 0.0)
    return wp.vec3(0.5 * d * x * x, d * v * x, d * v * v)


@wp.func
def friction_point(x: float, v: float, d: float, limit: float, alpha: float) -> wp.vec3:
    """Return the point at `alpha` of a dry-friction row."""
    value = friction_value(x + alpha * v, v, d, limit)
    start = friction_value(x, v, d, limit)
    return wp.vec3(value[0] - start[0], value[1], value[2])


@wp.func
def cone_zone(normal: float, tangent: float, mu: float) -> int:
    """Return the zone of a cone, whose tangent is its length."""
    if normal >= mu * tangent:
        return SATISFIED
    if mu * normal + tangent <= 0.0:
        return QUADRATIC
    return CONE


@wp.func
def prepare_cone(
    cones: wp.array[float],
    at: int,
    head: int,
    size: int,
    friction: wp.types.vector(length=5, dtype=float),
    mu: float,
    x: wp.array[float],
    v: wp.array[float],
    d: wp.array[float],
):
    """Write what the cone of rows `head` .. `head + size - 1` is along the search direction to `cones[at:]`."""
    dm = ratio(d[head], mu * mu * (1.0 + mu * mu))
    cost = 0.5 * d[head] * x[head] * x[head]
    slope = d[head] * x[head] * v[head]
    half_curvature = 0.5 * d[head] * v[head] * v[head]
    uu = float(0.0)
    uv = float(0.0)
    vv = float(0.0)
    aside = float(0.0)
    for k in range(1, size):
        row = head + k
        cost += 0.5 * d[row] * x[row] * x[row]
        slope += d[row] * x[row] * v[row]
        half_curvature += 0.5 * d[row] * v[row] * v[row]
        u_k = x[row] * friction[k - 1]
        v_k = v[row] * friction[k - 1]
        uu += u_k * u_k
        uv += u_k * v_k
        vv += v_k * v_k
        # |u|^2 |v|^2 - (u v)^2 as a sum of squares: nothing cancels.
        for j in range(1, k):
            minor = u_k * v[head + j] * friction[j - 1] - x[head + j] * friction[j - 1] * v_k
            aside += minor * minor
    speed = float(0.0)
    along = float(0.0)
    aside2 = float(uu)
    if vv > 0.0:
        speed = wp.sqrt(vv)
        along = uv / speed
        aside2 = aside / vv
    normal = x[head] * mu
    tangent = wp.sqrt(along * along + aside2)
    cones[at + _MU] = mu
    cones[at + _U0] = normal
    cones[at + _V0] = v[head] * mu
    cones[at + _ALONG] = along
    cones[at + _SPEED] = speed
    cones[at + _ASIDE2] = aside2
    cones[at + _DM] = dm
    cones[at + _COST] = cost
    cones[at + _SLOPE] = slope
    cones[at + _HALF_CURVATURE] = half_curvature
    cones[at + _T0] = tangent
    cones[at + _ZONE0] = float(cone_zone(normal, tangent, mu))


@wp.func
def cone_start(cones: wp.array[float], at: int) -> wp.vec3:
    """Return cost, slope and curvature of a cone at the start of the direction."""
    zone = int(cones[at + _ZONE0])
    if zone == SATISFIED:
        return wp.vec3(0.0)
    if zone == QUADRATIC:
        return wp.vec3(cones[at + _COST], cones[at + _SLOPE], 2.0 * cones[at + _HALF_CURVATURE])
    mu, dm, tangent = cones[at + _MU], cones[at + _DM], cones[at + _T0]
    gap = cones[at + _U0] - mu * tangent
    rate = cones[at + _ALONG] * cones[at + _SPEED] / tangent
    bend = (cones[at + _ASIDE2] / (tangent * tangent)) * (cones[at + _SPEED] * cones[at + _SPEED] / tangent)
    gap_rate = cones[at + _V0] - mu * rate
    return wp.vec3(0.5 * dm * gap * gap, dm * gap * gap_rate, dm * (gap_rate * gap_rate - mu * gap * bend))


@wp.func
def cone_point(cones: wp.array[float], at: int, alpha: float) -> wp.vec3:
    """Return the point at `alpha` of a cone."""
    mu, dm, u0, v0 = cones[at + _MU], cones[at + _DM], cones[at + _U0], cones[at + _V0]
    along, speed, aside2 = cones[at + _ALONG], cones[at + _SPEED], cones[at + _ASIDE2]
    tangent0, zone0 = cones[at + _T0], int(cones[at + _ZONE0])
    gap0 = u0 - mu * tangent0
    normal, ahead = u0 + alpha * v0, along + alpha * speed
    tangent2 = wp.max(ahead * ahead + aside2, 0.0)
    tangent = wp.sqrt(tangent2)
    zone = cone_zone(normal, tangent, mu)
    if zone == SATISFIED:
        if zone0 == SATISFIED:
            return wp.vec3(0.0)
        return wp.vec3(wp.where(zone0 == CONE, -0.5 * dm * gap0 * gap0, -cones[at + _COST]), 0.0, 0.0)

    # The quadratic cost of all rows exceeds that of the cone at the same point by dm / 2 (mu N + T)^2.
    half = alpha * cones[at + _HALF_CURVATURE]
    quadratic_change = alpha * (half + cones[at + _SLOPE])
    if zone == QUADRATIC:
        change = quadratic_change
        if zone0 == CONE:
            excess = mu * u0 + tangent0
            change += 0.5 * dm * excess * excess
        if zone0 == SATISFIED:
            change = 0.5 * dm * (1.0 + mu * mu) * (normal * normal + tangent2)
        return wp.vec3(change, 2.0 * half + cones[at + _SLOPE], 2.0 * cones[at + _HALF_CURVATURE])

    gap = normal - mu * tangent
    gap_rate = v0 - mu * ahead * speed / tangent
    bend = (aside2 / tangent2) * (speed * speed / tangent)
    change = 0.5 * dm * gap * gap
    if zone0 == CONE:
        # T - T0 from T^2 - T0^2, which is small by itself.
        further = alpha * v0 - mu * (alpha * speed * (along + ahead) / (tangent + tangent0))
        change = 0.5 * dm * further * (2.0 * gap0 + further)
    if zone0 == QUADRATIC:
        excess = mu * normal + tangent
        change = quadratic_change - 0.5 * dm * excess * excess
    return wp.vec3(change, dm * gap * gap_rate, dm * (gap_rate * gap_rate - mu * gap * bend))
