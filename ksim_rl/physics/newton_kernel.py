"""MuJoCo's Newton solver as one kernel: a warp solves a world from its start until that world has converged.

MuJoCo Warp launches about ten kernels per iteration, over all worlds, until the last of them has converged; here no
world waits for another, and what an iteration computes stays on the chip. The algorithm is the same: exact line search
by bracketed Newton steps, and the same tests of convergence, so that the results agree up to rounding.

Source of the algorithm: https://mujoco.readthedocs.io/en/stable/computation/index.html
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false, reportInvalidTypeForm=false
# Warp: a variable that changes in a loop is float(0.0), and what is static is decided by an `if` of its own.
# ruff: noqa: UP018, SIM102

import functools

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics import newton_lanes as lanes_
from ksim_rl.physics import newton_rows as rows_
from ksim_rl.physics.newton_lanes import sync, total
from ksim_rl.physics.newton_rows import (
    CONE,
    CONE_HEAD,
    CONE_TANGENT,
    EQUALITY,
    FLOATS_PER_ROW,
    FRICTION,
    LINEAR_NEGATIVE,
    LINEAR_POSITIVE,
    MINVAL,
    ONE_SIDED,
    QUADRATIC,
    SATISFIED,
    ratio,
)

vec5 = wp.types.vector(length=5, dtype=float)
OUT_OF_ITERATIONS = wp.constant(int(mjw.OverflowType.ITERATIONS))
OUT_OF_LS_ITERATIONS = wp.constant(int(mjw.OverflowType.LS_ITERATIONS))
ELLIPTIC_CONTACT = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC))
# Rounding of a sum of some float32 terms.
NOISE = wp.constant(8.0 * 1.1920929e-07)
# In the place of a stiffness: the row is the head of a cone in its curved zone.
CURVED = wp.constant(-1.0)


def floats_per_world(nv: int, njmax: int, *, elliptic: bool) -> int:
    """Return how many floats the lanes of a world share."""
    cones = (FLOATS_PER_ROW * (njmax + 3)) if elliptic else 0
    return (nv + 1) * (nv + 2) // 2 + 6 * nv + 5 * njmax + cones


@wp.func
def packed(row: int, col: int) -> int:
    """Return where an entry of a lower triangle is."""
    return row * (row + 1) // 2 + col


@wp.func
def floats_of(rows: wp.array2d[float], world: int) -> wp.array[float]:
    """Return a world's row, as an array whose stride the compiler knows."""
    width = rows.shape[1]
    return wp.array(ptr=rows.ptr + wp.uint64(4) * wp.uint64(world * width), shape=(width,), dtype=float)


@wp.func
def ints_of(rows: wp.array2d[int], world: int) -> wp.array[int]:
    """Return a world's row, as an array whose stride the compiler knows."""
    width = rows.shape[1]
    return wp.array(ptr=rows.ptr + wp.uint64(4) * wp.uint64(world * width), shape=(width,), dtype=int)


@wp.func
def factorize(h: wp.array[float], inverse_diag: wp.array[float], nv: int, lane: int, lanes: int):
    """Replace the lower triangle of H by its Cholesky factor, and the row below it, b, by the y of L y = b."""
    for col in range(nv):
        at = packed(col, 0)
        diag = h[at + col]
        for k in range(col):
            diag -= h[at + k] * h[at + k]
        inverse = 1.0 / wp.sqrt(wp.max(diag, MINVAL))
        for row in range(col + 1 + lane, nv + 1, lanes):
            below = packed(row, 0)
            entry = h[below + col]
            for k in range(col):
                # What overflows in one tree stays there: infinity times zero would be NaN.
                if h[at + k] != 0.0:
                    entry -= h[below + k] * h[at + k]
            h[below + col] = entry * inverse
        if lane == 0:
            inverse_diag[col] = inverse
        sync()


@wp.func
def back_substitute(
    h: wp.array[float], inverse_diag: wp.array[float], search: wp.array[float], nv: int, lane: int, lanes: int
):
    """Write the negated x of L' x = y, with L and y as `factorize` leaves them."""
    y = packed(nv, 0)
    for down in range(nv):
        row = nv - 1 - down
        x = h[y + row] * inverse_diag[row]
        at = packed(row, 0)
        for k in range(lane, row, lanes):
            if h[at + k] != 0.0:
                h[y + k] = h[y + k] - h[at + k] * x
        if lane == 0:
            search[row] = -x
        sync()


@wp.func
def in_bracket(end: wp.vec3, point: wp.vec3) -> bool:
    """Whether the slope of `point` has the sign of that of `end` and is smaller."""
    return (end[1] < point[1] and point[1] < 0.0) or (end[1] > point[1] and point[1] > 0.0)


@wp.func
def total3(value: wp.vec3) -> wp.vec3:
    """Return the sum of the lanes' vectors."""
    return wp.vec3(total(value[0]), total(value[1]), total(value[2]))


@functools.cache
def newton_kernel(
    *,
    nv: int,
    njmax: int,
    elliptic: bool,
    ls_iterations: int,
    lanes: int,
    worlds_per_block: int,
    min_blocks: int = 0,
) -> wp.Kernel:
    """Return the kernel for models of `nv` degrees of freedom; launch it over (worlds, lanes)."""
    NV, NJ, LANES, LS = nv, njmax, lanes, ls_iterations
    size = floats_per_world(nv, njmax, elliptic=elliptic)
    shared = lanes_.shared_floats(size, worlds_per_block)
    triangle = (nv + 1) * (nv + 2) // 2
    ACC, MA, SEARCH, MV, QFRC, DIAG = (wp.constant(4 * (triangle + i * nv)) for i in range(6))
    X, V, FORCE, KIND, D = (wp.constant(4 * (triangle + 6 * nv + i * njmax)) for i in range(5))
    CONES = wp.constant(4 * (triangle + 6 * nv + 5 * njmax))
    num_cones = FLOATS_PER_ROW * (njmax + 3) if elliptic else 1
    block = worlds_per_block * lanes
    bounds = {"launch_bounds": (block, min_blocks)} if min_blocks else {}

    @wp.func
    def row_start(
        kind: int,
        row: int,
        x: wp.array[float],
        v: wp.array[float],
        d: wp.array[float],
        limit: wp.array[float],
        cones: wp.array[float],
    ) -> wp.vec3:
        if kind == ONE_SIDED:
            return rows_.one_sided_start(x[row], v[row], d[row])
        if kind == FRICTION:
            return rows_.friction_value(x[row], v[row], d[row], limit[row])
        if wp.static(elliptic):
            if kind == CONE_HEAD:
                return rows_.cone_start(cones, FLOATS_PER_ROW * row)
        return wp.vec3(0.0)

    @wp.func
    def row_point(
        kind: int,
        row: int,
        alpha: float,
        x: wp.array[float],
        v: wp.array[float],
        d: wp.array[float],
        limit: wp.array[float],
        cones: wp.array[float],
    ) -> wp.vec3:
        if kind == ONE_SIDED:
            return rows_.one_sided_point(x[row], v[row], d[row], alpha)
        if kind == FRICTION:
            return rows_.friction_point(x[row], v[row], d[row], limit[row], alpha)
        if wp.static(elliptic):
            if kind == CONE_HEAD:
                return rows_.cone_point(cones, FLOATS_PER_ROW * row, alpha)
        return wp.vec3(0.0)

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options={"block_dim": block, "fast_math": True},
        **bounds,
    )
    def kernel(
        # Model.
        iterations: int,
        tolerances: wp.array[float],
        ls_tolerances: wp.array[float],
        impratio_invsqrts: wp.array[float],
        M_rownnz: wp.array[int],
        M_rowadr: wp.array[int],
        M_row: wp.array[int],
        M_col: wp.array[int],
        mulm_rowadr: wp.array[int],
        mulm_col: wp.array[int],
        mulm_adr: wp.array[int],
        # Data.
        ne: wp.array[int],
        nf: wp.array[int],
        nefc: wp.array[int],
        M: wp.array2d[float],
        warmstart: wp.array2d[float],
        qfrc_smooth: wp.array2d[float],
        contact_friction: wp.array[vec5],
        efc_type: wp.array2d[int],
        efc_id: wp.array2d[int],
        J_rownnz: wp.array2d[int],
        J_rowadr: wp.array2d[int],
        J_colind: wp.array2d[int],
        J: wp.array2d[float],
        efc_D: wp.array2d[float],
        efc_aref: wp.array2d[float],
        efc_limit: wp.array2d[float],
        dof_friction_row: wp.array2d[int],
        group_head: wp.array2d[int],
        group_size: wp.array2d[int],
        num_groups: wp.array[int],
        # Results.
        qacc: wp.array2d[float],
        efc_Ma: wp.array2d[float],
        efc_force: wp.array2d[float],
        efc_state: wp.array2d[int],
        qfrc_constraint: wp.array2d[float],
        solver_niter: wp.array[int],
        overflow: wp.array[int],
    ):
        world, lane = wp.tid()
        memory = shared()
        h = wp.array(ptr=memory, shape=(wp.static(triangle),), dtype=float)
        acc = wp.array(ptr=memory + wp.uint64(ACC), shape=(NV,), dtype=float)
        ma = wp.array(ptr=memory + wp.uint64(MA), shape=(NV,), dtype=float)
        search = wp.array(ptr=memory + wp.uint64(SEARCH), shape=(NV,), dtype=float)
        mv = wp.array(ptr=memory + wp.uint64(MV), shape=(NV,), dtype=float)
        qfrc = wp.array(ptr=memory + wp.uint64(QFRC), shape=(NV,), dtype=float)
        inverse_diag = wp.array(ptr=memory + wp.uint64(DIAG), shape=(NV,), dtype=float)
        x = wp.array(ptr=memory + wp.uint64(X), shape=(NJ,), dtype=float)
        v = wp.array(ptr=memory + wp.uint64(V), shape=(NJ,), dtype=float)
        force = wp.array(ptr=memory + wp.uint64(FORCE), shape=(NJ,), dtype=float)
        kinds = wp.array(ptr=memory + wp.uint64(KIND), shape=(NJ,), dtype=int)
        d = wp.array(ptr=memory + wp.uint64(D), shape=(NJ,), dtype=float)
        cones = wp.array(ptr=memory + wp.uint64(CONES), shape=(wp.static(num_cones),), dtype=float)
        limit = floats_of(efc_limit, world)
        M_w = floats_of(M, world)
        J_w = floats_of(J, world)
        J_col = ints_of(J_colind, world)
        J_adr = ints_of(J_rowadr, world)
        J_nnz = ints_of(J_rownnz, world)
        heads = ints_of(group_head, world)
        sizes = ints_of(group_size, world)
        friction_row = ints_of(dof_friction_row, world)
        smooth_force = floats_of(qfrc_smooth, world)
        ids = ints_of(efc_id, world)
        states = ints_of(efc_state, world)

        equalities = ne[world]
        frictions = nf[world]
        rows = wp.min(nefc[world], NJ)
        groups = num_groups[world]
        impratio_invsqrt = impratio_invsqrts[world % impratio_invsqrts.shape[0]]
        tolerance = tolerances[world % tolerances.shape[0]]
        ls_tolerance = ls_tolerances[world % ls_tolerances.shape[0]]

        # The start: the last acceleration, what it needs, and how far it is from the reference.
        trace = float(0.0)
        for i in range(lane, NV, LANES):
            acc[i] = warmstart[world, i]
            trace += M_w[M_rowadr[i] + M_rownnz[i] - 1]
        sync()
        scale = 1.0 / wp.max(MINVAL, total(trace))
        for i in range(lane, NV, LANES):
            product = float(0.0)
            for k in range(mulm_rowadr[i], mulm_rowadr[i + 1]):
                product += M_w[mulm_adr[k]] * acc[mulm_col[k]]
            ma[i] = product
        for row in range(lane, rows, LANES):
            residual = float(0.0)
            at = J_adr[row]
            for k in range(J_nnz[row]):
                residual += J_w[at + k] * acc[J_col[at + k]]
            x[row] = residual - efc_aref[world, row]
            d[row] = efc_D[world, row]
            kind = int(ONE_SIDED)
            if row < equalities:
                kind = EQUALITY
            elif row < equalities + frictions:
                kind = FRICTION
            if wp.static(elliptic):
                if efc_type[world, row] == ELLIPTIC_CONTACT:
                    kind = CONE_TANGENT
            kinds[row] = kind
        sync()
        if wp.static(elliptic):
            for group in range(lane, groups, LANES):
                head = heads[group]
                if kinds[head] == CONE_TANGENT:
                    kinds[head] = CONE_HEAD + (sizes[group] << 8)
            sync()

        iteration = int(0)
        solving = int(1)
        while solving > 0:
            # Forces and stiffnesses of the rows; the place of the rates is free between two line searches.
            for row in range(lane, rows, LANES):
                kind = kinds[row] & 255
                if kind == CONE_TANGENT:
                    continue
                stiffness = d[row]
                push = -stiffness * x[row]
                zone = int(QUADRATIC)
                if kind == ONE_SIDED and x[row] >= 0.0:
                    zone = SATISFIED
                if kind == FRICTION:
                    reach = ratio(limit[row], stiffness)
                    if x[row] <= -reach:
                        zone = LINEAR_NEGATIVE
                    elif x[row] >= reach:
                        zone = LINEAR_POSITIVE
                if wp.static(elliptic):
                    if kind == CONE_HEAD:
                        friction = contact_friction[ids[row]]
                        mu = friction[0] * impratio_invsqrt
                        tangent2 = float(0.0)
                        for k in range(1, kinds[row] >> 8):
                            u = x[row + k] * friction[k - 1]
                            tangent2 += u * u
                        tangent = wp.sqrt(tangent2)
                        normal = x[row] * mu
                        zone = rows_.cone_zone(normal, tangent, mu)
                        dm = ratio(stiffness, mu * mu * (1.0 + mu * mu))
                        slide = float(0.0)
                        if zone == CONE:
                            push = -dm * (normal - mu * tangent) * mu
                            slide = -ratio(push, tangent)
                        for k in range(1, kinds[row] >> 8):
                            mate = row + k
                            pull = slide * x[mate] * friction[k - 1] * friction[k - 1]
                            if zone == QUADRATIC:
                                pull = -d[mate] * x[mate]
                            force[mate] = pull
                            v[mate] = wp.where(zone == QUADRATIC, d[mate], 0.0)
                            states[mate] = zone
                if zone == SATISFIED:
                    push = 0.0
                if zone == LINEAR_NEGATIVE:
                    push = limit[row]
                if zone == LINEAR_POSITIVE:
                    push = -limit[row]
                force[row] = push
                v[row] = wp.where(zone == QUADRATIC, stiffness, 0.0)
                if zone == CONE:
                    v[row] = CURVED
                states[row] = zone
            for i in range(lane, NV, LANES):
                qfrc[i] = 0.0
            sync()

            # J' force. The rows of a group share their columns, and no two groups are added at once.
            for group in range(groups):
                head = heads[group]
                at = J_adr[head]
                support = J_nnz[head]
                size_of_group = sizes[group]
                for k in range(lane, support, LANES):
                    pull = float(0.0)
                    for mate in range(size_of_group):
                        pull += force[head + mate] * J_w[at + mate * support + k]
                    qfrc[J_col[at + k]] = qfrc[J_col[at + k]] + pull
                sync()
            if frictions > 0:
                for i in range(lane, NV, LANES):
                    row = friction_row[i]
                    if row >= 0:
                        qfrc[i] = qfrc[i] + force[row]
                sync()
            gradient2 = float(0.0)
            for i in range(lane, NV, LANES):
                slope = ma[i] - smooth_force[i] - qfrc[i]
                h[packed(NV, i)] = slope
                gradient2 += slope * slope
            gradient2 = total(gradient2)
            if solving == 2 or (iteration > 0 and scale * wp.sqrt(gradient2) < tolerance):
                solving = 0

            if solving == 1:
                # H = M + J' D J, and the curvature of cones that slide.
                for i in range(lane, wp.static(nv * (nv + 1) // 2), LANES):
                    h[i] = 0.0
                sync()
                for k in range(lane, M_row.shape[0], LANES):
                    h[packed(M_row[k], M_col[k])] = M_w[k]
                sync()
                if frictions > 0:
                    for i in range(lane, NV, LANES):
                        row = friction_row[i]
                        if row >= 0:
                            h[packed(i, i)] = h[packed(i, i)] + v[row]
                    sync()
                for group in range(groups):
                    head = heads[group]
                    at = J_adr[head]
                    support = J_nnz[head]
                    size_of_group = sizes[group]
                    curved = v[head] == CURVED
                    active = curved
                    if not curved:
                        for mate in range(size_of_group):
                            active = active or v[head + mate] != 0.0
                    if active:
                        friction = vec5()
                        mu = float(0.0)
                        dm = float(0.0)
                        flat = float(0.0)
                        stretch = float(0.0)
                        per_tangent = float(0.0)
                        if wp.static(elliptic):
                            if curved:
                                friction = contact_friction[ids[head]]
                                mu = friction[0] * impratio_invsqrt
                                dm = ratio(d[head], mu * mu * (1.0 + mu * mu))
                                tangent2 = float(0.0)
                                for k in range(1, size_of_group):
                                    u = x[head + k] * friction[k - 1]
                                    tangent2 += u * u
                                per_tangent = 1.0 / wp.max(wp.sqrt(tangent2), MINVAL)
                                stretch = mu * x[head] * mu * per_tangent
                                flat = mu * mu - stretch
                        for entry in range(lane, support * (support + 1) // 2, LANES):
                            b = int((wp.sqrt(float(8 * entry + 1)) - 1.0) * 0.5)
                            a = entry - b * (b + 1) // 2
                            value = float(0.0)
                            if wp.static(elliptic):
                                if curved:
                                    normal_a = mu * J_w[at + a]
                                    normal_b = mu * J_w[at + b]
                                    slide_a = float(0.0)
                                    slide_b = float(0.0)
                                    dot = float(0.0)
                                    for k in range(1, size_of_group):
                                        z_a = friction[k - 1] * J_w[at + k * support + a]
                                        z_b = friction[k - 1] * J_w[at + k * support + b]
                                        u = x[head + k] * friction[k - 1] * per_tangent
                                        slide_a += u * z_a
                                        slide_b += u * z_b
                                        dot += z_a * z_b
                                    value = dm * (
                                        normal_a * normal_b
                                        - mu * (normal_a * slide_b + normal_b * slide_a)
                                        + stretch * slide_a * slide_b
                                        + flat * dot
                                    )
                            if not curved:
                                for mate in range(size_of_group):
                                    row_at = at + mate * support
                                    value += v[head + mate] * J_w[row_at + a] * J_w[row_at + b]
                            dof_a = J_col[at + a]
                            dof_b = J_col[at + b]
                            h[packed(wp.max(dof_a, dof_b), wp.min(dof_a, dof_b))] = (
                                h[packed(wp.max(dof_a, dof_b), wp.min(dof_a, dof_b))] + value
                            )
                        sync()
                factorize(h, inverse_diag, NV, lane, LANES)
                decrement = float(0.0)
                for i in range(lane, NV, LANES):
                    y = h[packed(NV, i)]
                    decrement += y * y
                decrement = total(decrement)
                if iteration > 0:
                    if 0.5 * scale * decrement < tolerance:
                        solving = 0
                    elif iteration == iterations:
                        solving = 0
                        if lane == 0:
                            overflow[world] = overflow[world] | OUT_OF_ITERATIONS

            if solving == 1:
                sync()
                back_substitute(h, inverse_diag, search, NV, lane, LANES)
                search2 = float(0.0)
                slope = float(0.0)
                half_curvature = float(0.0)
                for i in range(lane, NV, LANES):
                    product = float(0.0)
                    for k in range(mulm_rowadr[i], mulm_rowadr[i + 1]):
                        product += M_w[mulm_adr[k]] * search[mulm_col[k]]
                    mv[i] = product
                    search2 += search[i] * search[i]
                    slope += search[i] * (ma[i] - smooth_force[i])
                    half_curvature += 0.5 * search[i] * product
                for row in range(lane, rows, LANES):
                    rate = float(0.0)
                    at = J_adr[row]
                    for k in range(J_nnz[row]):
                        rate += J_w[at + k] * search[J_col[at + k]]
                    v[row] = rate
                    if row < equalities:
                        slope += d[row] * rate * x[row]
                        half_curvature += 0.5 * d[row] * rate * rate
                sync()
                smooth = total3(wp.vec3(search2, slope, half_curvature))
                slope = smooth[1]
                half_curvature = smooth[2]
                starts = wp.vec3(0.0)
                for row in range(lane, rows, LANES):
                    kind = kinds[row] & 255
                    if wp.static(elliptic):
                        if kind == CONE_HEAD:
                            friction = contact_friction[ids[row]]
                            rows_.prepare_cone(
                                cones,
                                FLOATS_PER_ROW * row,
                                row,
                                kinds[row] >> 8,
                                friction,
                                friction[0] * impratio_invsqrt,
                                x,
                                v,
                                d,
                            )
                    starts += row_start(kind, row, x, v, d, limit, cones)
                starts = total3(starts)

                # The line search keeps two points whose slopes it drives to zero, and takes the better one.
                enough = wp.max(tolerance * ls_tolerance * wp.sqrt(smooth[0]) / scale, 1e-6)
                start = wp.vec3(0.0, slope + starts[1], 2.0 * half_curvature + starts[2])
                gross = wp.sqrt(2.0 * wp.max(starts[0], 0.0) * wp.max(starts[2], 0.0)) + wp.abs(slope)
                accepted = wp.max(enough, NOISE * gross)
                alpha = float(0.0)
                improvement = float(0.0)
                searching = int(1)
                if rows == 0:
                    alpha = 1.0
                    searching = 0
                elif wp.abs(start[1]) < NOISE * gross:
                    searching = 0
                low = wp.vec3(0.0, start[1], start[2])
                high = wp.vec3(0.0, start[1], start[2])
                low_alpha = float(0.0)
                high_alpha = float(0.0)
                if searching == 1:
                    step = -ratio(start[1], start[2])
                    local = wp.vec3(0.0)
                    for row in range(lane, rows, LANES):
                        local += row_point(kinds[row] & 255, row, step, x, v, d, limit, cones)
                    point = total3(local) + wp.vec3(
                        step * (step * half_curvature + slope),
                        2.0 * step * half_curvature + slope,
                        2.0 * half_curvature,
                    )
                    if wp.abs(point[1]) < accepted and point[0] < 0.0:
                        searching = 0
                        alpha = step
                        improvement = -point[0]
                    elif point[1] < start[1]:
                        low = point
                        low_alpha = step
                    else:
                        high = point
                        high_alpha = step
                trial = int(0)
                while searching == 1 and trial < LS:
                    trial += 1
                    alpha_1 = low_alpha - ratio(low[1], low[2])
                    alpha_2 = high_alpha - ratio(high[1], high[2])
                    alpha_3 = 0.5 * (low_alpha + high_alpha)
                    local_1 = wp.vec3(0.0)
                    local_2 = wp.vec3(0.0)
                    local_3 = wp.vec3(0.0)
                    for row in range(lane, rows, LANES):
                        kind = kinds[row] & 255
                        local_1 += row_point(kind, row, alpha_1, x, v, d, limit, cones)
                        local_2 += row_point(kind, row, alpha_2, x, v, d, limit, cones)
                        local_3 += row_point(kind, row, alpha_3, x, v, d, limit, cones)
                    hc2 = 2.0 * half_curvature
                    point_1 = total3(local_1) + wp.vec3(
                        alpha_1 * (alpha_1 * half_curvature + slope), alpha_1 * hc2 + slope, hc2
                    )
                    point_2 = total3(local_2) + wp.vec3(
                        alpha_2 * (alpha_2 * half_curvature + slope), alpha_2 * hc2 + slope, hc2
                    )
                    point_3 = total3(local_3) + wp.vec3(
                        alpha_3 * (alpha_3 * half_curvature + slope), alpha_3 * hc2 + slope, hc2
                    )
                    best = wp.vec3(0.0)
                    best_alpha = float(0.0)
                    if wp.abs(point_1[1]) < accepted and point_1[0] < best[0]:
                        best = point_1
                        best_alpha = alpha_1
                    if wp.abs(point_2[1]) < accepted and point_2[0] < best[0]:
                        best = point_2
                        best_alpha = alpha_2
                    if wp.abs(point_3[1]) < accepted and point_3[0] < best[0]:
                        best = point_3
                        best_alpha = alpha_3
                    if best[0] < 0.0:
                        low = best
                        low_alpha = best_alpha
                        high = best
                        high_alpha = best_alpha
                        searching = 0
                    else:
                        moved = int(0)
                        if in_bracket(low, point_1):
                            low = point_1
                            low_alpha = alpha_1
                            moved = 1
                        if in_bracket(low, point_3):
                            low = point_3
                            low_alpha = alpha_3
                            moved = 1
                        if in_bracket(low, point_2):
                            low = point_2
                            low_alpha = alpha_2
                            moved = 1
                        # A step from a point that fell short and lands beyond the minimum makes a bracket.
                        if in_bracket(high, point_2) or (high[1] < 0.0 and point_2[1] > 0.0):
                            high = point_2
                            high_alpha = alpha_2
                            moved = 1
                        if in_bracket(high, point_3):
                            high = point_3
                            high_alpha = alpha_3
                            moved = 1
                        if in_bracket(high, point_1):
                            high = point_1
                            high_alpha = alpha_1
                            moved = 1
                        if (
                            moved == 0
                            or (low[0] < 0.0 and low[1] < 0.0 and low[1] > -enough)
                            or (high[0] < 0.0 and high[1] > 0.0 and high[1] < enough)
                        ):
                            searching = 0
                    if low[0] < 0.0 or high[0] < 0.0:
                        if low[0] < high[0]:
                            alpha = low_alpha
                            improvement = -low[0]
                        else:
                            alpha = high_alpha
                            improvement = -high[0]
                if searching == 1 and lane == 0:
                    overflow[world] = overflow[world] | OUT_OF_LS_ITERATIONS

                for i in range(lane, NV, LANES):
                    acc[i] = acc[i] + alpha * search[i]
                    ma[i] = ma[i] + alpha * mv[i]
                for row in range(lane, rows, LANES):
                    x[row] = x[row] + alpha * v[row]
                sync()
                iteration += 1
                if rows == 0 or alpha == 0.0 or (improvement > 0.0 and scale * improvement < tolerance):
                    solving = 2

        for i in range(lane, NV, LANES):
            qacc[world, i] = acc[i]
            efc_Ma[world, i] = ma[i]
            qfrc_constraint[world, i] = qfrc[i]
        for row in range(lane, rows, LANES):
            efc_force[world, row] = force[row]
        if lane == 0:
            solver_niter[world] = iteration

    return kernel
