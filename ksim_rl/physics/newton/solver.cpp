// The last part: Newton's method, from the rows to the accelerations and forces.

// What the rows are is looked up once.
#pragma unroll 1
for (int i = lane; i < NV * STRIDE; i += LANES)
    mass[i] = 0.0f;
each_row(0, 1, Singly {}, [&](int row, float* J) {
#pragma unroll 1
    for (int j = lane; j < STRIDE; j += LANES)
        J[j] = 0.0f;
});
UNROLL
for (int b = 0; b < BLOCKS; ++b) {
    acc[b] = row_of(problem.warmstart)[dof_of(b)];
    smooth[b] = row_of(problem.qfrc_smooth)[dof_of(b)];
    if (is_dof(b))
        shared[dof_of(b)] = bounded(acc[b]);
}
sync();
#pragma unroll 4
for (int k = lane; k < problem.M_row.shape[0]; k += LANES) {
    const int row = problem.M_row.data[k], col = problem.M_col.data[k];
    mass[row * STRIDE + col] = mass[col * STRIDE + row] = row_of(problem.M)[k];
}
each_row(lane, LANES, Singly {}, [&](int row, float* J) {
    const int at = row_of(problem.J_rowadr)[row];
    const int end = at + row_of(problem.J_rownnz)[row];
    const float* const values = row_of(problem.J_values);
    const int* const cols = row_of(problem.J_colind);
    float product = 0.0f;
#pragma unroll 4
    for (int k = at; k < end; ++k) {
        J[cols[k]] = values[k];
        product += values[k] * shared[cols[k]];
    }
    x[row] = product - row_of(problem.efc_aref)[row];
    d[row] = row_of(problem.efc_D)[row];
    kinds[row] = row < equalities ? EQUALITY : row < equalities + frictions ? FRICTION : ONE_SIDED;
    bound[row] = row_of(problem.efc_limit)[row];
    if (ELLIPTIC) {
        const int* const types = row_of(problem.efc_type);
        const int* const ids = row_of(problem.efc_id);
        auto is_of_cone = [&](int mate) {
            return mate >= 0 && mate < rows && types[mate] == ELLIPTIC_CONTACT && ids[mate] == ids[row];
        };
        if (is_of_cone(row)) {
            const float* const friction = (const float*)(problem.contact_friction.data + ids[row]);
            int before = 0, after = 1;
            while (is_of_cone(row - before - 1))
                ++before;
            while (is_of_cone(row + after))
                ++after;
            kinds[row] = before > 0 ? CONE_TANGENT : CONE_HEAD + (after << 8);
            bound[row] = before > 0 ? friction[before - 1] : friction[0] * impratio;
        }
    }
});
sync();
#pragma unroll 1
for (int first = 0; first < rows; first += LANES) {
    const int row = first + lane;
    const bool counts = row >= equalities && row < rows && (!ELLIPTIC || kinds[row] != CONE_TANGENT);
#if defined(__CUDA_ARCH__)
    const unsigned all = __ballot_sync(0xffffffffu, counts);
    if (counts)
        units[num_units + __popc(all & ((1u << lane) - 1u))] = row;
    num_units += __popc(all);
#else
    if (counts)
        units[num_units++] = row;
#endif
}
sync();

times_mass(ma, acc);
float trace = 0.0f;
UNROLL
for (int b = 0; b < BLOCKS; ++b)
    trace += is_dof(b) ? mass[dof_of(b) * (STRIDE + 1)] : 0.0f;
const float scale = 1.0f / wp::max(TINY, total(trace));

int iteration = 0;
bool last = false;
while (true) {
#pragma unroll 1
    for (int row = lane; row < rows; row += LANES)
        push(row);
    sync();
    pull_back();
    float gradient2 = 0.0f;
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        slopes[b] = ma[b] - smooth[b] - pull[b];
        gradient2 += is_dof(b) ? slopes[b] * slopes[b] : 0.0f;
    }
    if (last || (iteration > 0 && scale * sqrtf(total(gradient2)) < tolerance))
        break;
    build_h();
    factorize();
    float decrement = 0.0f;
UNROLL
    for (int b = 0; b < BLOCKS; ++b)
        decrement += is_dof(b) ? slopes[b] * slopes[b] * inverse[b] : 0.0f;
    if (iteration > 0 && 0.5f * scale * total(decrement) < tolerance)
        break;
    if (iteration == problem.iterations) {
        if (lane == 0)
            problem.overflow.data[world] |= OUT_OF_ITERATIONS;
        break;
    }
    back_substitute();
    times_mass(mv, slopes);
    float search2 = 0.0f, slope = 0.0f, half_curvature = 0.0f, noise = 0.0f;
UNROLL
    for (int b = 0; b < BLOCKS; ++b)
        if (is_dof(b)) {
            search2 += slopes[b] * slopes[b];
            slope += slopes[b] * (ma[b] - smooth[b]);
            half_curvature += 0.5f * slopes[b] * mv[b];
        }
    each_row(lane, LANES, Singly {}, [&](int row, const float* J) {
        float rate = 0.0f;
UNROLL
        for (int j = 0; j < NV; ++j)
            rate += J[j] * shared[j];
        v[row] = rate;
        noise += fabsf(force[row] * rate);
        if (row < equalities) {
            slope += d[row] * rate * x[row];
            half_curvature += 0.5f * d[row] * rate * rate;
        }
    });
    sync();
    search2 = total(search2);
    slope = total(slope);
    half_curvature = total(half_curvature);
    noise = NOISE * (total(noise) + fabsf(slope));
    if (ELLIPTIC) {
#pragma unroll 1
        for (int unit = lane; unit < num_units; unit += LANES)
            if ((kinds[units[unit]] & 255) == CONE_HEAD)
                prepare_cone(units[unit], kinds[units[unit]] >> 8);
        sync();
    }

    // The line search keeps two points whose slopes it drives to zero, and takes the better one. Its trials
    // measure three points each, on CUDA by eight lanes each; the first trial is of the start and of the
    // Newton step.
    const float enough = wp::max(tolerance * ls_tolerance * sqrtf(search2) / scale, 1e-6f);
    float alpha = rows == 0 ? 1.0f : 0.0f, improvement = 0.0f, accepted = wp::max(enough, noise);
    float alphas[3] = {0.0f, 1.0f, 1.0f}, low_alpha = 0.0f, high_alpha = 0.0f;
    Point low {0.0f, 0.0f, 0.0f}, high = low;
#pragma unroll 1
    for (int trial = -1; rows > 0; ++trial) {
        if (trial == MOST_TRIALS) {
            if (lane == 0)
                problem.overflow.data[world] |= OUT_OF_LS_ITERATIONS;
            break;
        }
        if (trial >= 0) {
            alphas[0] = low_alpha - ratio(low.slope, low.curvature);
            alphas[1] = high_alpha - ratio(high.slope, high.curvature);
            alphas[2] = 0.5f * (low_alpha + high_alpha);
        }
        Point points[3];
#if defined(__CUDA_ARCH__)
        const int mine = lane >> 3;
        const float at = mine == 0 ? alphas[0] : mine == 1 ? alphas[1] : alphas[2];
        Point sum = measure(at, mine == 3 ? NJ : lane & 7, 8);
UNROLL
        for (int distance = 4; distance > 0; distance >>= 1) {
            sum.cost += __shfl_xor_sync(0xffffffffu, sum.cost, distance);
            sum.slope += __shfl_xor_sync(0xffffffffu, sum.slope, distance);
            sum.curvature += __shfl_xor_sync(0xffffffffu, sum.curvature, distance);
        }
#endif
UNROLL
        for (int i = 0; i < 3; ++i) {
#if defined(__CUDA_ARCH__)
            points[i].cost = __shfl_sync(0xffffffffu, sum.cost, 8 * i);
            points[i].slope = __shfl_sync(0xffffffffu, sum.slope, 8 * i);
            points[i].curvature = __shfl_sync(0xffffffffu, sum.curvature, 8 * i);
#else
            points[i] = i == 2 && trial < 0 ? points[1] : measure(alphas[i], 0, 1);
#endif
        }
UNROLL
        for (int i = 0; i < 3; ++i) {
            points[i].cost += alphas[i] * (alphas[i] * half_curvature + slope);
            points[i].slope += 2.0f * alphas[i] * half_curvature + slope;
            points[i].curvature += 2.0f * half_curvature;
        }
        if (trial < 0) {
            low = high = points[0];
            if (fabsf(low.slope) < noise)
                break;
        }
        int best = -1;
#pragma unroll
        for (int i = 0; i < 3; ++i)
            if ((i > 0 || trial >= 0) && fabsf(points[i].slope) < accepted
                && points[i].cost < (best < 0 ? 0.0f : improvement)) {
                best = i;
                improvement = points[i].cost;
                alpha = alphas[i];
            }
        if (best >= 0) {
            improvement = -improvement;
            break;
        }
        if (trial < 0) {
            if (points[1].slope < low.slope) {
                low = points[1];
                low_alpha = alphas[1];
            } else {
                high = points[1];
                high_alpha = alphas[1];
            }
            continue;
        }
        bool moved = false;
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            const int which = i == 0 ? 0 : i == 1 ? 2 : 1;
            if (in_bracket(low, points[which])) {
                low = points[which];
                low_alpha = alphas[which];
                moved = true;
            }
        }
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            const int which = i == 0 ? 1 : i == 1 ? 2 : 0;
            // A step from a point that fell short and lands beyond the minimum makes a bracket.
            const bool crosses = i == 0 && high.slope < 0.0f && points[which].slope > 0.0f;
            if (crosses || in_bracket(high, points[which])) {
                high = points[which];
                high_alpha = alphas[which];
                moved = true;
            }
        }
        if (low.cost < 0.0f || high.cost < 0.0f) {
            alpha = low.cost < high.cost ? low_alpha : high_alpha;
            improvement = -wp::min(low.cost, high.cost);
        }
        const bool low_is_flat = low.cost < 0.0f && low.slope < 0.0f && low.slope > -enough;
        const bool high_is_flat = high.cost < 0.0f && high.slope > 0.0f && high.slope < enough;
        if (!moved || low_is_flat || high_is_flat)
            break;
    }
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        acc[b] += alpha * slopes[b];
        ma[b] += alpha * mv[b];
    }
#pragma unroll 1
    for (int row = lane; row < rows; row += LANES)
        x[row] += alpha * v[row];
    sync();
    ++iteration;
    last = rows == 0 || alpha == 0.0f || (improvement > 0.0f && scale * improvement < tolerance);
}

UNROLL
for (int b = 0; b < BLOCKS; ++b)
    if (is_dof(b)) {
        row_of(problem.qacc)[dof_of(b)] = acc[b];
        row_of(problem.efc_Ma)[dof_of(b)] = ma[b];
        row_of(problem.qfrc_constraint)[dof_of(b)] = pull[b];
    }
#pragma unroll 1
for (int row = lane; row < rows; row += LANES)
    row_of(problem.efc_force)[row] = force[row];
if (lane == 0)
    problem.solver_niter.data[world] = iteration;
#undef UNROLL
