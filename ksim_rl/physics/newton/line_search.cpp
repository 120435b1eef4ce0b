// Part 7: the exact line search along qacc + alpha search (computation chapter, "Algorithms"; mujoco_warp's
// solver.py, _linesearch_iterative_kernel). Along it a row's residual is r + alpha rate, and the cost a sum of
// functions of alpha, of each of which its value relative to alpha = 0, its slope and its curvature are needed.

struct Point {
    float cost, slope, curvature;  // the cost is relative to that at the start of the direction
};
// 1/2 D (r + alpha rate)^2 where that residual is negative.
auto one_sided = [](float at_start, float rate, float efc_D, float alpha) {
    const float slope = efc_D * rate * at_start, curvature = efc_D * rate * rate;
    const float start = at_start < 0.0f ? 0.5f * efc_D * at_start * at_start : 0.0f;
    if (at_start + alpha * rate >= 0.0f && !(alpha == 0.0f && at_start < 0.0f))
        return Point {-start, 0.0f, 0.0f};
    const float change = alpha * (slope + 0.5f * alpha * curvature);
    return Point {
        at_start < 0.0f ? change : change + 0.5f * efc_D * at_start * at_start,
        slope + alpha * curvature,
        curvature
    };
};
// Quadratic up to the bound on the force, and linear from there on.
auto dry_friction = [&](float at_start, float rate, float efc_D, float most, float alpha) {
    const float reach = ratio(most, efc_D);
    auto cost = [&](float at) {
        return fabsf(at) >= reach ? most * (fabsf(at) - 0.5f * reach) : 0.5f * efc_D * at * at;
    };
    const float there = at_start + alpha * rate;
    const bool linear = there <= -reach || there >= reach;
    const float slope = there <= -reach ? -most * rate : there >= reach ? most * rate : efc_D * rate * there;
    return Point {cost(there) - cost(at_start), slope, linear ? 0.0f : efc_D * rate * rate};
};
// A cone along the direction: N + alpha N_rate, and a slip whose part along its own rate is `along` + alpha
// `speed`, while the square of its part across is `aside2` throughout. So T^2 = (along + alpha speed)^2 + aside2.
struct alignas(16) Cone {
    float mu, N, N_rate, along, speed, aside2, Dm, cost, slope, half_curvature, T, state;
};
auto prepare_cone = [&](int head) {
    const int size = cone_size(head);
    Cone cone {};
    cone.mu = bound[head];
    cone.N = residual[head] * cone.mu;
    cone.N_rate = rate[head] * cone.mu;
    cone.Dm = cone_Dm(head);
    float slip[MOST_OF_CONE] {}, faster[MOST_OF_CONE] {}, slip_rate = 0.0f, rate_rate = 0.0f;
UNROLL
    for (int mate = 0; mate < MOST_OF_CONE; ++mate)
        if (mate < size) {
            const int row = head + mate;
            const float push = efc_D[row] * residual[row];
            cone.cost += 0.5f * push * residual[row];
            cone.slope += push * rate[row];
            cone.half_curvature += 0.5f * efc_D[row] * rate[row] * rate[row];
            if (mate > 0) {
                slip[mate] = residual[row] * bound[row];
                faster[mate] = rate[row] * bound[row];
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
};
auto cone_point = [&](const Cone& cone, float alpha) {
    const int state_0 = (int)cone.state;
    const float gap_0 = cone.N - cone.mu * cone.T;
    const float start = state_0 == CURVED ? 0.5f * cone.Dm * gap_0 * gap_0 : state_0 == QUADRATIC ? cone.cost : 0.0f;
    const float N = cone.N + alpha * cone.N_rate, ahead = cone.along + alpha * cone.speed;
    const float T2 = ahead * ahead + cone.aside2, T = sqrtf(T2);
    const int state = cone_zone(N, T, cone.mu);
    if (state == SATISFIED)
        return Point {-start, 0.0f, 0.0f};
    // The quadratic cost of all rows exceeds that of the cone at the same point by Dm / 2 (mu N + T)^2.
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
};
// What a unit costs at a point of the search direction.
auto unit_point = [&](int row, float alpha) {
    const int kind = kind_of(row);
    if (ELLIPTIC && kind == CONE_HEAD)
        return cone_point(*(const Cone*)(cones + 4 * row), alpha);
    if (kind == FRICTION)
        return dry_friction(residual[row], rate[row], efc_D[row], bound[row], alpha);
    return one_sided(residual[row], rate[row], efc_D[row], alpha);
};
auto in_bracket = [](const Point& end, const Point& point) {
    return end.slope * point.slope > 0.0f && fabsf(point.slope) < fabsf(end.slope);
};

// The step to take, and by how much it lowers the cost. `slope` and `half_curvature` are those of the terms that
// are quadratic everywhere: the Gauss cost of M and the equalities.
struct Step {
    float alpha, improvement;
};
// The search keeps two points whose slopes it drives to zero, and takes the better one. Its trials measure three
// points each, on CUDA by a team of eight lanes each; the first trial is of the start and of the Newton step.
auto search_line = [&](float slope, float half_curvature, float enough, float noise) {
    float alpha = rows == 0 ? 1.0f : 0.0f, improvement = 0.0f, accepted = wp::max(enough, noise);
    constexpr int TEAM = LANES > 1 ? 8 : 1;
    if (ELLIPTIC) {
#pragma unroll 1
        for (int unit = lane; unit < num_units; unit += LANES)
            if (kind_of(units[unit]) == CONE_HEAD)
                *(Cone*)(cones + 4 * units[unit]) = prepare_cone(units[unit]);
        sync();
    }
    auto measure = [&](float there) {
        Point sum {0.0f, 0.0f, 0.0f};
#pragma unroll 1
        for (int unit = lane % TEAM; unit < num_units; unit += TEAM) {
            const Point point = unit_point(units[unit], there);
            sum.cost += point.cost;
            sum.slope += point.slope;
            sum.curvature += point.curvature;
        }
        return sum;
    };
    float alphas[3] = {0.0f, 1.0f, 1.0f}, low_alpha = 0.0f, high_alpha = 0.0f;
    Point low {0.0f, 0.0f, 0.0f}, high = low;
#pragma unroll 1
    for (int trial = -1; rows > 0; ++trial) {
        if (trial == MOST_TRIALS) {
            if (lane == 0)
                wp::atomic_or(problem.overflow.data + world, OUT_OF_LS_ITERATIONS);
            break;
        }
        if (trial >= 0) {
            alphas[0] = low_alpha - ratio(low.slope, low.curvature);
            alphas[1] = high_alpha - ratio(high.slope, high.curvature);
            alphas[2] = 0.5f * (low_alpha + high_alpha);
        }
        Point points[3];
#if defined(__CUDA_ARCH__)
        const int mine = lane / TEAM;
        const float at = mine == 0 ? alphas[0] : mine == 1 ? alphas[1] : alphas[2];
        Point sum = measure(at);
        const float pool = pooled(sum.cost, sum.slope, sum.curvature, 0.0f, TEAM);
#endif
UNROLL
        for (int i = 0; i < 3; ++i) {
#if defined(__CUDA_ARCH__)
            points[i].cost = of_lane(pool, TEAM * i);
            points[i].slope = of_lane(pool, TEAM * i + 1);
            points[i].curvature = of_lane(pool, TEAM * i + 2);
#else
            points[i] = i == 2 && trial < 0 ? points[1] : measure(alphas[i]);
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
            require(low.slope <= noise, SEARCH_DESCENDS);
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
    return Step {alpha, improvement};
};
