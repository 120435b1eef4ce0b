// Newton's method, from its start to the accelerations and forces (computation chapter, "Algorithms"). Read the parts in
// their order: layout.cuh, constraints.cuh, cost.cuh, limbs.cuh, tiles.cuh, hessian.cuh, line_search.cuh.
//
// It ends, as mujoco_warp's solver.py (_solve_done) does, once the scaled gradient, Newton decrement or improvement
// is below the tolerance, or a line search finds nothing better.
#pragma once
#include "ksim_rl/physics/newton/constraints.cuh"
#include "ksim_rl/physics/newton/hessian.cuh"
#include "ksim_rl/physics/newton/line_search.cuh"

namespace newton {

// The start is the warm start, or zero where that is cheaper; C compares with the unconstrained acceleration, which
// nothing here computes. Without rows it is zero: the one step from there rounds by what it finds, not by how far away
// the warm start is.
CUDA_CALLABLE inline void choose_start(const Solve& s)
{
    times_mass(s, s.M_qacc, s.qacc);
    float excess = 0.0f;
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        excess += s.is_dof(block) ? s.qacc[block] * (0.5f * s.M_qacc[block] - s.qfrc_smooth[block]) : 0.0f;
#pragma unroll 1
    for (int row = s.lane; row < s.rows; row += LANES)
#pragma unroll 1
        for (int at_zero = 0; at_zero < 2; ++at_zero) {
            const float cost = cost_of(s, row, [&](int mate) {
                return at_zero ? -s.row_of(s.a.efc_aref)[mate] : s.residual[mate];
            });
            excess += at_zero ? -cost : cost;
        }
    if (s.rows == 0 || total(excess) > 0.0f) {
UNROLL
        for (int block = 0; block < BLOCKS; ++block)
            s.qacc[block] = s.M_qacc[block] = 0.0f;
        sync();
#pragma unroll 1
        for (int row = s.lane; row < s.rows; row += LANES)
            s.residual[row] = s.efc_D[row] > 0.0f ? -s.row_of(s.a.efc_aref)[row] : 0.0f;
        sync();
    }
}

// What makes costs comparable between models: the inverse of the trace of M.
CUDA_CALLABLE inline float scale_of(const Solve& s)
{
    float trace = 0.0f;
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        trace += s.is_dof(block) ? s.mass[s.slot_of(block) * (STRIDE + 1)] : 0.0f;
    return 1.0f / wp::max(TINY, total(trace));
}

// How the Hessian is summed and solved with: along the limbs of the kinematic tree, or as a whole.
struct ByLimbs {
    static CUDA_CALLABLE void sum(const Solve& s)
    {
        if (TILED)
            sum_tiles(s);
        else
            build_hessian<NarrowRows>(s);
    }

    static CUDA_CALLABLE float eliminate(const Solve& s)
    {
        return factorize_limbs(s);
    }

    static CUDA_CALLABLE void substitute(const Solve& s)
    {
        search_along_limbs(s);
    }
};

struct Densely {
    static CUDA_CALLABLE void sum(const Solve& s)
    {
        build_hessian<WholeRows>(s);
    }

    static CUDA_CALLABLE float eliminate(const Solve& s)
    {
        return factorize(s);
    }

    static CUDA_CALLABLE void substitute(const Solve& s)
    {
        back_substitute(s);
    }
};

// Sets the gradient, then the search direction, or returns that the accelerations are good enough or the last.
template <class Way>
CUDA_CALLABLE inline bool find_search(const Solve& s, int iteration, float scale)
{
    Way::sum(s);
    float gradient2 = 0.0f;
UNROLL
    for (int block = 0; block < BLOCKS; ++block) {
        s.gradient[block] = s.M_qacc[block] - s.qfrc_smooth[block] - s.qfrc_constraint[block];
        gradient2 += s.is_dof(block) ? s.gradient[block] * s.gradient[block] : 0.0f;
    }
    if (iteration > 0 && scale * sqrtf(total(gradient2)) < s.tolerance)
        return true;
    const float decrement = Way::eliminate(s);
    if (iteration > 0 && 0.5f * scale * decrement < s.tolerance)
        return true;
    if (iteration == s.a.iterations) {
        if (s.lane == 0)
            wp::atomic_or(s.a.overflow.data + s.world.world, OUT_OF_ITERATIONS);
        return true;
    }
    Way::substitute(s);
    return false;
}

// J search of one row.
CUDA_CALLABLE inline float rate_of(const Solve& s, int row, const float* jacobian)
{
    float product = 0.0f;
    if (s.by_limbs) {
        const float* const of_limb = s.spread + s.limb_of(row) * LIMB_STRIDE;
UNROLL
        for (int place = 0; place < TRUNK; ++place)
            product += jacobian[place] * s.spread[place];
UNROLL
        for (int place = LIMB_BEGIN; place < LIMB_BEGIN + LIMB; ++place)
            product += jacobian[place] * of_limb[place];
    } else {
UNROLL
        for (int dof = 0; dof < NV; ++dof)
            product += jacobian[dof] * s.shared[dof];
    }
    return product;
}

// Returns the step along the search direction, for which it needs M search, J search, and the terms of the cost that are
// quadratic everywhere.
CUDA_CALLABLE inline Step find_step(const Solve& s)
{
    times_mass(s, s.M_search, s.search);
    float slope_0 = 0.0f, slope = 0.0f, half_curvature = 0.0f, noise = 0.0f;
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        if (s.is_dof(block)) {
            slope += s.search[block] * (s.M_qacc[block] - s.qfrc_smooth[block]);
            half_curvature += 0.5f * s.search[block] * s.M_search[block];
        }
    s.each_row<1>(s.lane, LANES, [&](int row, const float* jacobian) {
        const float product = rate_of(s, row, jacobian);
        s.rate[row] = product;
        noise += fabsf(s.force[row] * product);
        slope_0 -= row < s.equalities ? 0.0f : s.force[row] * product;
        if (row < s.equalities) {
            slope += s.efc_D[row] * product * s.residual[row];
            half_curvature += 0.5f * s.efc_D[row] * product * product;
        }
    });
    sync();
    if (LANES > 1) {
        const float pool = pooled(s.lane, slope_0, slope, half_curvature, noise, LANES);
        slope_0 = of_lane(pool, 0);
        slope = of_lane(pool, 1);
        half_curvature = of_lane(pool, 2);
        noise = of_lane(pool, 3);
    }
    noise = NOISE * (noise + fabsf(slope));
    return search_line(s, slope, half_curvature, slope + slope_0, noise);
}

// Goes on from the start until nothing improves, and returns the number of iterations.
CUDA_CALLABLE inline int descend(const Solve& s, float scale)
{
    int iteration = 0;
    bool last = false;
    while (true) {
#pragma unroll 1
        for (int row = s.lane; row < s.rows; row += LANES)
            update_row(s, row);
        sync();
        if (last) {
            pull_back(s);
            break;
        }
        if (s.by_limbs ? find_search<ByLimbs>(s, iteration, scale) : find_search<Densely>(s, iteration, scale))
            break;
        const Step step = find_step(s);
        s.require(step.alpha >= 0.0f && step.improvement >= 0.0f, COST_FALLS);
UNROLL
        for (int block = 0; block < BLOCKS; ++block) {
            s.qacc[block] += step.alpha * s.search[block];
            s.M_qacc[block] += step.alpha * s.M_search[block];
        }
#pragma unroll 1
        for (int row = s.lane; row < s.rows; row += LANES)
            s.residual[row] += step.alpha * s.rate[row];
        sync();
        ++iteration;
        last = s.rows == 0 || step.alpha == 0.0f || (step.improvement > 0.0f && scale * step.improvement < s.tolerance);
    }
    return iteration;
}

CUDA_CALLABLE inline void write_results(const Solve& s, int iterations)
{
UNROLL
    for (int block = 0; block < BLOCKS; ++block)
        if (s.is_dof(block)) {
            s.row_of(s.a.qacc)[s.dof_of(block)] = s.qacc[block];
            s.row_of(s.a.efc_Ma)[s.dof_of(block)] = s.M_qacc[block];
            s.row_of(s.a.qfrc_constraint)[s.dof_of(block)] = s.qfrc_constraint[block];
        }
#pragma unroll 1
    for (int row = s.lane; row < s.rows; row += LANES)
        s.row_of(s.a.efc_force)[row] = s.force[row];
    if (s.lane == 0)
        s.a.solver_niter.data[s.world.world] = iterations;
}

CUDA_CALLABLE inline void run(int index, int lane, const Arguments& a)
{
#if defined(__CUDA_ARCH__)
    __shared__ __align__(16) float memory[FLOATS];
#else
    alignas(16) static float memory[FLOATS];
#endif
    float qacc[BLOCKS], M_qacc[BLOCKS], M_search[BLOCKS], qfrc_smooth[BLOCKS], qfrc_constraint[BLOCKS];
    float search[BLOCKS], inverse_pivot[BLOCKS], hessian[BLOCKS][NV], own_row[BLOCKS][NARROW], rest[ENTRIES];
    int limbs[BLOCKS], places[BLOCKS];
    const Registers registers {
        qacc, M_qacc, M_search, qfrc_smooth, qfrc_constraint, search, search, inverse_pivot, hessian, limbs, places,
        own_row, rest,
    };
    const World world = world_of(a.order.data[index], lane);
    Solve s(a, world, memory, registers);
    measure_rows(s);
    read_constraints(s);
    if (s.by_limbs)
        clear_limbs(s);
    if (TILED && s.by_limbs)
        list_rows(s);
    choose_start(s);
    const float scale = scale_of(s);
    const int iterations = descend(s, scale);
    write_results(s, iterations);
}

}
