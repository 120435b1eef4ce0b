// Part 8: Newton's method, from its start to the accelerations and forces (computation chapter, "Algorithms").
// It ends, as mujoco_warp's solver.py (_solve_done) does, once the scaled gradient, Newton decrement or improvement
// is below the tolerance, or a line search finds nothing better.

if (by_limbs)
    clear_limbs();
if (TILED && by_limbs)
    list_rows();
times_mass(M_qacc, qacc);
// The start is the warm start, or zero where that is cheaper; C compares with the unconstrained acceleration, which
// nothing here computes. Without rows it is zero: the one step from there rounds by what it finds, not by how far away
// the warm start is.
float excess = 0.0f;
UNROLL
for (int block = 0; block < BLOCKS; ++block)
    excess += is_dof(block) ? qacc[block] * (0.5f * M_qacc[block] - qfrc_smooth[block]) : 0.0f;
#pragma unroll 1
for (int row = lane; row < rows; row += LANES)
#pragma unroll 1
    for (int at_zero = 0; at_zero < 2; ++at_zero) {
        const float cost = cost_of(row, [&](int mate) {
            return at_zero ? -row_of(problem.efc_aref)[mate] : residual[mate];
        });
        excess += at_zero ? -cost : cost;
    }
if (rows == 0 || total(excess) > 0.0f) {
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        qacc[block] = M_qacc[block] = 0.0f;
    sync();
#pragma unroll 1
    for (int row = lane; row < rows; row += LANES)
        residual[row] = efc_D[row] > 0.0f ? -row_of(problem.efc_aref)[row] : 0.0f;
    sync();
}
float trace = 0.0f;
UNROLL
for (int block = 0; block < BLOCKS; ++block)
    trace += is_dof(block) ? mass[slot_of(block) * (STRIDE + 1)] : 0.0f;
const float scale = 1.0f / wp::max(TINY, total(trace));

int iteration = 0;
bool last = false;
// Sets the gradient, then the search direction, or returns that the accelerations are good enough or the last.
auto find_search = [&](auto sum, auto eliminate, auto substitute) {
    sum();
    float gradient2 = 0.0f;
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        gradient[block] = M_qacc[block] - qfrc_smooth[block] - qfrc_constraint[block];
        gradient2 += is_dof(block) ? gradient[block] * gradient[block] : 0.0f;
    }
    if (iteration > 0 && scale * sqrtf(total(gradient2)) < tolerance)
        return true;
    const float decrement = eliminate();
    if (iteration > 0 && 0.5f * scale * decrement < tolerance)
        return true;
    if (iteration == problem.iterations) {
        if (lane == 0)
            wp::atomic_or(problem.overflow.data + world, OUT_OF_ITERATIONS);
        return true;
    }
    substitute();
    return false;
};
auto sum_by_limbs = [&] {
    if (TILED)
        sum_tiles();
    else
        build_hessian(start_own_rows, add_to_own_rows);
};
auto sum_densely = [&] { build_hessian(start_rows, add_outer_product); };
while (true) {
#pragma unroll 1
    for (int row = lane; row < rows; row += LANES)
        update_row(row);
    sync();
    if (last) {
        pull_back();
        break;
    }
    if (by_limbs ? find_search(sum_by_limbs, factorize_limbs, search_along_limbs)
                 : find_search(sum_densely, factorize, back_substitute))
        break;

    // Along the search direction: M search, J search, and the terms of the cost that are quadratic everywhere.
    times_mass(M_search, search);
    float slope_0 = 0.0f, slope = 0.0f, half_curvature = 0.0f, noise = 0.0f;
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        if (is_dof(block)) {
            slope += search[block] * (M_qacc[block] - qfrc_smooth[block]);
            half_curvature += 0.5f * search[block] * M_search[block];
        }
    each_row(lane, LANES, Singly {}, [&](int row, const float* jacobian) {
        float product = 0.0f;
        if (by_limbs) {
            const float* const of_limb = spread + limb_of(row) * LIMB_STRIDE;
UNROLL
            for (int place = 0; place < TRUNK; ++place)
                product += jacobian[place] * spread[place];
UNROLL
            for (int place = LIMB_BEGIN; place < LIMB_BEGIN + LIMB; ++place)
                product += jacobian[place] * of_limb[place];
        } else {
UNROLL
            for (int dof = 0; dof < NV; ++dof)
                product += jacobian[dof] * shared[dof];
        }
        rate[row] = product;
        noise += fabsf(force[row] * product);
        slope_0 -= row < equalities ? 0.0f : force[row] * product;
        if (row < equalities) {
            slope += efc_D[row] * product * residual[row];
            half_curvature += 0.5f * efc_D[row] * product * product;
        }
    });
    sync();
    if (LANES > 1) {
        const float pool = pooled(slope_0, slope, half_curvature, noise, LANES);
        slope_0 = of_lane(pool, 0);
        slope = of_lane(pool, 1);
        half_curvature = of_lane(pool, 2);
        noise = of_lane(pool, 3);
    }
    noise = NOISE * (noise + fabsf(slope));
    const Step step = search_line(slope, half_curvature, slope + slope_0, noise);
    require(step.alpha >= 0.0f && step.improvement >= 0.0f, COST_FALLS);
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        qacc[block] += step.alpha * search[block];
        M_qacc[block] += step.alpha * M_search[block];
    }
#pragma unroll 1
    for (int row = lane; row < rows; row += LANES)
        residual[row] += step.alpha * rate[row];
    sync();
    ++iteration;
    last = rows == 0 || step.alpha == 0.0f || (step.improvement > 0.0f && scale * step.improvement < tolerance);
}

UNROLL
for (int block = 0; block < BLOCKS; ++block)
    if (is_dof(block)) {
        row_of(problem.qacc)[dof_of(block)] = qacc[block];
        row_of(problem.efc_Ma)[dof_of(block)] = M_qacc[block];
        row_of(problem.qfrc_constraint)[dof_of(block)] = qfrc_constraint[block];
    }
#pragma unroll 1
for (int row = lane; row < rows; row += LANES)
    row_of(problem.efc_force)[row] = force[row];
if (lane == 0)
    problem.solver_niter.data[world] = iteration;
#undef UNROLL
