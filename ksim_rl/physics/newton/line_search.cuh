// Part 7: the line search along qacc + alpha search (computation chapter, "Algorithms"), to a slope that is a share of
// that at the start, where mujoco_warp's (solver.py, _linesearch_iterative_kernel) goes on to the last bits. Along it a
// row's residual is r + alpha rate, and the cost a sum of functions of alpha, of each of which its value relative to
// alpha = 0, its slope and its curvature are needed.
#pragma once
#include "ksim_rl/physics/newton/cost.cuh"

namespace newton {

struct Point {
    float cost, slope, curvature;  // the cost is relative to that at the start of the direction
};

// 1/2 D (r + alpha rate)^2 where that residual is negative.
CUDA_CALLABLE inline Point one_sided(float at_start, float rate, float efc_D, float alpha)
{
    const float slope = efc_D * rate * at_start, curvature = efc_D * rate * rate;
    const float start = at_start < 0.0f ? 0.5f * efc_D * at_start * at_start : 0.0f;
    if (at_start + alpha * rate >= 0.0f)
        return Point {-start, 0.0f, 0.0f};
    const float change = alpha * (slope + 0.5f * alpha * curvature);
    return Point {
        at_start < 0.0f ? change : change + 0.5f * efc_D * at_start * at_start,
        slope + alpha * curvature,
        curvature
    };
}

// Quadratic up to the bound on the force, and linear from there on.
CUDA_CALLABLE inline Point dry_friction(float at_start, float rate, float efc_D, float most, float alpha)
{
    const float reach = ratio(most, efc_D);
    auto cost = [&](float at) {
        return fabsf(at) >= reach ? most * (fabsf(at) - 0.5f * reach) : 0.5f * efc_D * at * at;
    };
    const float there = at_start + alpha * rate;
    const bool linear = there <= -reach || there >= reach;
    const float slope = there <= -reach ? -most * rate : there >= reach ? most * rate : efc_D * rate * there;
    return Point {cost(there) - cost(at_start), slope, linear ? 0.0f : efc_D * rate * rate};
}

// A cone along the direction: N + alpha N_rate, and a slip whose part along its own rate is `along` + alpha
// `speed`, while the square of its part across is `aside2` throughout. So T^2 = (along + alpha speed)^2 + aside2.
struct alignas(16) Cone {
    float mu, N, N_rate, along, speed, aside2, Dm, cost, slope, half_curvature, T, state;
};

CUDA_CALLABLE inline Cone prepare_cone(const Solve& s, int head)
{
    const int size = s.cone_size(head);
    Cone cone {};
    cone.mu = s.bound[head];
    cone.N = s.residual[head] * cone.mu;
    cone.N_rate = s.rate[head] * cone.mu;
    cone.Dm = cone_Dm(s, head);
    float slip[MOST_OF_CONE] {}, faster[MOST_OF_CONE] {}, slip_rate = 0.0f, rate_rate = 0.0f;
UNROLL
    for (int mate = 0; mate < MOST_OF_CONE; ++mate)
        if (mate < size) {
            const int row = head + mate;
            const float push = s.efc_D[row] * s.residual[row];
            cone.cost += 0.5f * push * s.residual[row];
            cone.slope += push * s.rate[row];
            cone.half_curvature += 0.5f * s.efc_D[row] * s.rate[row] * s.rate[row];
            if (mate > 0) {
                slip[mate] = s.residual[row] * s.bound[row];
                faster[mate] = s.rate[row] * s.bound[row];
                slip_rate += slip[mate] * faster[mate];
                rate_rate += faster[mate] * faster[mate];
            }
        }
    cone.speed = sqrtf(rate_rate);
    cone.along = rate_rate > 0.0f ? slip_rate / cone.speed : 0.0f;
    const float when = rate_rate > 0.0f ? slip_rate / rate_rate : 0.0f;
    // The part of the slip across its rate, term by term: as a difference of squares it would cancel.
UNROLL
    for (int mate = 1; mate < MOST_OF_CONE; ++mate) {
        const float across = slip[mate] - when * faster[mate];
        cone.aside2 += across * across;
    }
    cone.T = sqrtf(cone.along * cone.along + cone.aside2);
    cone.state = (float)cone_zone(cone.N, cone.T, cone.mu);
    return cone;
}

CUDA_CALLABLE inline Point cone_point(const Cone& cone, float alpha)
{
    const int state_0 = (int)cone.state;
    const float gap_0 = cone.N - cone.mu * cone.T;
    const float start = state_0 == CURVED ? 0.5f * cone.Dm * gap_0 * gap_0 : state_0 == QUADRATIC ? cone.cost : 0.0f;
    const float N = cone.N + alpha * cone.N_rate, ahead = cone.along + alpha * cone.speed;
    const float T2 = ahead * ahead + cone.aside2, T = sqrtf(T2);
    const int state = cone_zone(N, T, cone.mu);
    if (state == SATISFIED)
        return Point {-start, 0.0f, 0.0f};
    // The quadratic cost of all rows exceeds the cone's cost at the same point by Dm / 2 (mu N + T)^2.
    const float half = alpha * cone.half_curvature, quadratic = alpha * (half + cone.slope);
    if (state == QUADRATIC) {
        const float excess = cone.mu * cone.N + cone.T;
        const float change = state_0 == CURVED ? quadratic + 0.5f * cone.Dm * excess * excess
            : state_0 == SATISFIED ? 0.5f * cone.Dm * (1.0f + cone.mu * cone.mu) * (N * N + T2)
            : quadratic;
        return Point {change, 2.0f * half + cone.slope, 2.0f * cone.half_curvature};
    }
    // Of 1/2 Dm (N - mu T)^2; T' = ahead speed / T, and T'' = aside2 speed^2 / T^3.
    const float gap = N - cone.mu * T;
    const float gap_rate = cone.N_rate - cone.mu * ahead * cone.speed / T;
    const float bend = (cone.aside2 / T2) * (cone.speed * cone.speed / T);
    float change = 0.5f * cone.Dm * gap * gap;
    if (state_0 == CURVED) {  // T - T0 from T^2 - T0^2, which is small by itself
        const float lengthening = alpha * cone.speed * (cone.along + ahead) / (T + cone.T);
        const float further = alpha * cone.N_rate - cone.mu * lengthening;
        change = 0.5f * cone.Dm * further * (2.0f * gap_0 + further);
    } else if (state_0 == QUADRATIC) {
        const float excess = cone.mu * N + T;
        change = quadratic - 0.5f * cone.Dm * excess * excess;
    }
    return Point {change, cone.Dm * gap * gap_rate, cone.Dm * (gap_rate * gap_rate - cone.mu * gap * bend)};
}

// What a unit costs at a point of the search direction.
CUDA_CALLABLE inline Point unit_point(const Solve& s, int row, float alpha)
{
    const int kind = s.kind_of(row);
    if (ELLIPTIC && kind == CONE_HEAD)
        return cone_point(*(const Cone*)(s.cones + 4 * row), alpha);
    if (kind == FRICTION)
        return dry_friction(s.residual[row], s.rate[row], s.efc_D[row], s.bound[row], alpha);
    return one_sided(s.residual[row], s.rate[row], s.efc_D[row], alpha);
}

// The step to take, and by how much it lowers the cost. `slope` and `half_curvature` belong to the terms that are
// quadratic everywhere: the Gauss cost of M and the equalities; `slope_0` is the slope of all terms at the start.
struct Step {
    float alpha, improvement;
};

// The search keeps the points before and beyond the minimum that are flattest. Its trials measure four points each, on
// CUDA by a team of eight lanes each, and take of those that are flat enough the cheapest. To ask more than ten times
// ls_tolerance of the slope at the start saves no iteration, and costs trials (Go1: 1.9 an iteration with ls_tolerance
// itself, 1.5 with ten times that).
CUDA_CALLABLE inline Step search_line(const Solve& s, float slope, float half_curvature, float slope_0, float noise)
{
    constexpr int TEAM = LANES > 1 ? 8 : 1, POINTS = 4;
    Step step {s.rows == 0 ? 1.0f : 0.0f, 0.0f};
    s.require(s.rows == 0 || slope_0 <= noise, SEARCH_DESCENDS);
    if (s.rows == 0 || !(slope_0 < -noise))
        return step;
    if (ELLIPTIC) {
#pragma unroll 1
        for (int unit = s.lane; unit < s.num_units; unit += LANES)
            if (s.kind_of(s.units[unit]) == CONE_HEAD)
                *(Cone*)(s.cones + 4 * s.units[unit]) = prepare_cone(s, s.units[unit]);
        sync();
    }
    auto measure = [&](float there) {
        Point sum {0.0f, 0.0f, 0.0f};
#pragma unroll 1
        for (int unit = s.lane % TEAM; unit < s.num_units; unit += TEAM) {
            const Point point = unit_point(s, s.unit_of(unit), there);
            sum.cost += point.cost;
            sum.slope += point.slope;
            sum.curvature += point.curvature;
        }
        return sum;
    };
    const float flat = wp::max(noise, 10.0f * s.ls_tolerance * -slope_0);
    float alphas[POINTS] = {1.0f, 0.5f, 0.25f, 0.1f}, low_alpha = 0.0f, high_alpha = 0.0f;
    Point low {0.0f, slope_0, 0.0f}, high {0.0f, LARGEST, 0.0f};
#pragma unroll 1
    for (int trial = 0;; ++trial) {
#if defined(__CUDA_ARCH__)
        const int team = s.lane / TEAM;
        const Point sum = measure(team == 0 ? alphas[0] : team == 1 ? alphas[1] : team == 2 ? alphas[2] : alphas[3]);
        const float pool = pooled(s.lane, sum.cost, sum.slope, sum.curvature, 0.0f, TEAM);
#endif
        bool found = false, moved = false;
UNROLL
        for (int i = 0; i < POINTS; ++i) {
            const float alpha = alphas[i];
#if defined(__CUDA_ARCH__)
            Point point {of_lane(pool, TEAM * i), of_lane(pool, TEAM * i + 1), of_lane(pool, TEAM * i + 2)};
#else
            Point point = measure(alpha);
#endif
            point.cost += alpha * (alpha * half_curvature + slope);
            point.slope += 2.0f * alpha * half_curvature + slope;
            point.curvature += 2.0f * half_curvature;
            if (fabsf(point.slope) < flat && point.cost < -step.improvement) {
                found = true;
                step = Step {alpha, -point.cost};
            }
            if (point.slope < 0.0f && point.slope > low.slope) {
                moved = true;
                low = point;
                low_alpha = alpha;
            }
            if (point.slope >= 0.0f && point.slope < high.slope) {
                moved = true;
                high = point;
                high_alpha = alpha;
            }
        }
        if (found)
            return step;
        if (!moved || trial == MOST_TRIALS) {
            if (moved && s.lane == 0)
                wp::atomic_or(s.a.overflow.data + s.world.world, OUT_OF_LS_ITERATIONS);
            const float cost = wp::min(low.cost, high.cost);
            return cost < 0.0f ? Step {low.cost < high.cost ? low_alpha : high_alpha, -cost} : step;
        }
        // Where nothing rises yet, up to four times as far as the lower point's Newton step.
        const float ahead = -ratio(low.slope, low.curvature), back = ratio(high.slope, high.curvature);
        const float end = high.slope < LARGEST ? high_alpha : low_alpha + 4.0f * ahead, width = end - low_alpha;
        alphas[0] = low_alpha + (ahead < width ? ahead : 0.25f * width);
        alphas[1] = end - (back < width ? back : 0.25f * width);
        alphas[2] = low_alpha + 0.5f * width;
        alphas[3] = low_alpha + width * ratio(low.slope, low.slope - high.slope);
    }
}

}
