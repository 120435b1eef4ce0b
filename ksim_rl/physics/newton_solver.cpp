// The body of the function that solves one world; newton_kernel.py gives its arguments and the constants
// NV, NJ, LANES, WORLDS_PER_BLOCK, STRIDE, ROWS_ON_CHIP, FLOATS, MOST_TRIALS, ELLIPTIC, and says what it is about.
//
// The lanes of a world share out its degrees of freedom: lane l has l, l + LANES, ..., of which each is a `block` with
// its row of H from the block's first column on, so that on CUDA the rows of H lie in registers, symmetric within a
// block, and with one lane (the CPU) they are the upper triangle. J and M lie on the chip as whole rows, zeros included:
// then the sums over them have no index to look up, and all lanes read the same address or adjacent ones.
//
// x is the residual J qacc - aref of a row, v its rate J search, d its stiffness.

#if defined(__CUDA_ARCH__)
#define UNROLL _Pragma("unroll")
#else
#define UNROLL
#endif

constexpr int EQUALITY = 0, FRICTION = 1, ONE_SIDED = 2, CONE_HEAD = 3, CONE_TANGENT = 4;
constexpr int SATISFIED = 0, QUADRATIC = 1, LINEAR_NEGATIVE = 2, LINEAR_POSITIVE = 3, CURVED = 4;
constexpr int ELLIPTIC_CONTACT = 7;
constexpr float TINY = 1e-15f, LARGEST = 3e38f;
constexpr float NOISE = 8.0f * 1.1920929e-07f;  // rounding of a sum of some float32 terms
constexpr int BLOCKS = (NV + LANES - 1) / LANES;
constexpr int COLUMN = STRIDE + 4;

#if defined(__CUDA_ARCH__)
__shared__ __align__(16) float floats[WORLDS_PER_BLOCK * FLOATS];
float* const memory = floats + (threadIdx.x / LANES) * FLOATS;
#else
static float memory[FLOATS];
#endif
float* const mass = memory;
float* const chip = mass + NV * STRIDE;
float* const columns = chip + ROWS_ON_CHIP * STRIDE;  // two
float* const shared = columns + 2 * COLUMN;  // a vector of the degrees of freedom, for all lanes to read
float* const x = shared + STRIDE;
float* const v = x + PADDED_ROWS;  // between two line searches: the stiffness of the row, 0 where it is slack
float* const force = v + PADDED_ROWS;
float* const d = force + PADDED_ROWS;
float* const bound = d + PADDED_ROWS;  // the most force of dry friction, the mu of a cone's head, the friction of its tangents
int* const kinds = (int*)(bound + PADDED_ROWS);
int* const units = kinds + PADDED_ROWS;  // the rows whose cost is evaluated: all but equalities and tangents
float* const cones = (float*)(units + PADDED_ROWS);

auto row_of = [=](auto& array) { return array.data + (size_t)world * array.shape[1]; };
auto of_world = [=](auto& array) { return array.data[world % array.shape[0]]; };
const int rows = wp::min(problem.nefc.data[world], NJ), equalities = problem.ne.data[world], frictions = problem.nf.data[world];
const float impratio = of_world(problem.impratio_invsqrt);
const float tolerance = of_world(problem.tolerance);
const float ls_tolerance = of_world(problem.ls_tolerance);
int* const states = row_of(problem.efc_state);
const int near_rows = wp::min(rows, ROWS_ON_CHIP);
float* const far = row_of(problem.scratch) - near_rows * STRIDE;

auto sync = [] {
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
};
auto total = [](float value) {
#if defined(__CUDA_ARCH__)
UNROLL
    for (int distance = LANES / 2; distance > 0; distance >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, distance);
#endif
    return value;
};
auto of_lane = [](float value, int lane) {
#if defined(__CUDA_ARCH__)
    value = __shfl_sync(0xffffffffu, value, lane);
#endif
    return value;
};
// What overflows in one tree stays there: in the sums of another tree infinity times zero would be NaN.
auto bounded = [](float value) { return wp::clamp(value, -LARGEST, LARGEST); };
// Calls body(row, its J) for the rows first, first + stride, ...: on chip, and those that found no room there.
struct Singly {
    enum { AT_ONCE = 1 };
};
struct ByFours {
    enum { AT_ONCE = 4 };
};
auto each_row = [&](int first, int stride, auto pace, auto body) {
#pragma unroll decltype(pace)::AT_ONCE
    for (int row = first; row < near_rows; row += stride)
        body(row, chip + row * STRIDE);
    if (ROWS_ON_CHIP < NJ)
#pragma unroll 1
        for (int row = near_rows + first; row < rows; row += stride)
            body(row, far + row * STRIDE);
};
auto row_at = [&](int row) { return (row < near_rows ? chip : far) + row * STRIDE; };
auto ratio = [](float a, float b) { return a / (b == 0.0f ? TINY : b); };
// A lane beyond the last degree of freedom does what the lane of the last one does, and writes nothing.
auto is_dof = [&](int block) { return block * LANES + lane < NV; };
auto dof_of = [&](int block) { return wp::min(block * LANES + lane, NV - 1); };

struct Point {
    float cost, slope, curvature;  // the cost is relative to that at the start of the direction
};
struct Cone {
    float mu, u0, v0, along, speed, aside2, dm, cost, slope, half_curvature, tangent, zone;
};
auto cone_zone = [](float normal, float tangent, float mu) {
    return normal >= mu * tangent ? SATISFIED : mu * normal + tangent <= 0.0f ? QUADRATIC : CURVED;
};

auto one_sided = [](float x, float v, float d, float alpha) {
    const float slope = d * v * x, curvature = d * v * v, start = x < 0.0f ? 0.5f * d * x * x : 0.0f;
    if (x + alpha * v >= 0.0f && !(alpha == 0.0f && x < 0.0f))
        return Point {-start, 0.0f, 0.0f};
    const float change = alpha * (slope + 0.5f * alpha * curvature);
    return Point {x < 0.0f ? change : change + 0.5f * d * x * x, slope + alpha * curvature, curvature};
};
auto dry_friction = [&](float x, float v, float d, float most, float alpha) {
    const float reach = ratio(most, d);
    auto cost = [&](float at) {
        return at <= -reach ? most * (-0.5f * reach - at) : at >= reach ? most * (-0.5f * reach + at) : 0.5f * d * at * at;
    };
    const float there = x + alpha * v;
    const bool linear = there <= -reach || there >= reach;
    const float slope = there <= -reach ? -most * v : there >= reach ? most * v : d * v * there;
    return Point {cost(there) - cost(x), slope, linear ? 0.0f : d * v * v};
};
auto cone_point = [&](const Cone& c, float alpha) {
    const int zone0 = (int)c.zone;
    const float gap0 = c.u0 - c.mu * c.tangent;
    const float start = zone0 == CURVED ? 0.5f * c.dm * gap0 * gap0 : zone0 == QUADRATIC ? c.cost : 0.0f;
    const float normal = c.u0 + alpha * c.v0, ahead = c.along + alpha * c.speed;
    const float tangent2 = ahead * ahead + c.aside2, tangent = sqrtf(tangent2);
    const int zone = cone_zone(normal, tangent, c.mu);
    if (zone == SATISFIED)
        return Point {-start, 0.0f, 0.0f};
    // The quadratic cost of all rows exceeds that of the cone at the same point by dm / 2 (mu N + T)^2.
    const float half = alpha * c.half_curvature, quadratic = alpha * (half + c.slope);
    if (zone == QUADRATIC) {
        const float excess = c.mu * c.u0 + c.tangent;
        const float change = zone0 == CURVED ? quadratic + 0.5f * c.dm * excess * excess
            : zone0 == SATISFIED ? 0.5f * c.dm * (1.0f + c.mu * c.mu) * (normal * normal + tangent2) : quadratic;
        return Point {change, 2.0f * half + c.slope, 2.0f * c.half_curvature};
    }
    const float gap = normal - c.mu * tangent;
    const float gap_rate = c.v0 - c.mu * ahead * c.speed / tangent;
    const float bend = (c.aside2 / tangent2) * (c.speed * c.speed / tangent);
    float change = 0.5f * c.dm * gap * gap;
    if (zone0 == CURVED) {  // T - T0 from T^2 - T0^2, which is small by itself
        const float further = alpha * c.v0 - c.mu * (alpha * c.speed * (c.along + ahead) / (tangent + c.tangent));
        change = 0.5f * c.dm * further * (2.0f * gap0 + further);
    } else if (zone0 == QUADRATIC) {
        const float excess = c.mu * normal + tangent;
        change = quadratic - 0.5f * c.dm * excess * excess;
    }
    return Point {change, c.dm * gap * gap_rate, c.dm * (gap_rate * gap_rate - c.mu * gap * bend)};
};
auto prepare_cone = [&](int head, int size) {
    Cone c {};
    c.mu = bound[head];
    c.u0 = x[head] * c.mu;
    c.v0 = v[head] * c.mu;
    c.dm = ratio(d[head], c.mu * c.mu * (1.0f + c.mu * c.mu));
    float uu = 0.0f, uv = 0.0f, vv = 0.0f;
#pragma unroll 1
    for (int row = head; row < head + size; ++row) {
        const float push = d[row] * x[row];
        c.cost += 0.5f * push * x[row];
        c.slope += push * v[row];
        c.half_curvature += 0.5f * d[row] * v[row] * v[row];
        if (row == head)
            continue;
        const float u = x[row] * bound[row], rate = v[row] * bound[row];
        uu += u * u;
        uv += u * rate;
        vv += rate * rate;
    }
    c.speed = sqrtf(vv);
    c.along = vv > 0.0f ? uv / c.speed : 0.0f;
    const float when = vv > 0.0f ? uv / vv : 0.0f;
    // The part of the slip across its rate, term by term: as a difference of squares it would cancel.
#pragma unroll 1
    for (int row = head + 1; row < head + size; ++row) {
        const float across = (x[row] - when * v[row]) * bound[row];
        c.aside2 += across * across;
    }
    c.tangent = sqrtf(c.along * c.along + c.aside2);
    c.zone = (float)cone_zone(c.u0, c.tangent, c.mu);
    *(Cone*)(cones + 4 * head) = c;
};

// The start. What the rows are is looked up once.
#pragma unroll 1
for (int i = lane; i < NV * STRIDE; i += LANES)
    mass[i] = 0.0f;
each_row(0, 1, Singly {}, [&](int row, float* J) {
#pragma unroll 1
    for (int j = lane; j < STRIDE; j += LANES)
        J[j] = 0.0f;
});
float acc[BLOCKS], ma[BLOCKS], mv[BLOCKS], smooth[BLOCKS], pull[BLOCKS], slopes[BLOCKS], inverse[BLOCKS];
float h[BLOCKS][NV];
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
int num_units = 0;
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

// M times the vector that the lanes share, of which each has its own entries.
auto times_mass = [&](float* result, const float* own) {
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        float product = 0.0f;
UNROLL
        for (int j = 0; j < NV; ++j)
            product += mass[j * STRIDE + dof_of(b)] * shared[j];
        result[b] = fabsf(own[b]) <= LARGEST ? product : own[b];
    }
};
// The force of a row, and its stiffness in the place of its rate.
auto push = [&](int row) {
    const int kind = kinds[row] & 255;
    if (kind == CONE_TANGENT)
        return;
    int zone = QUADRATIC;
    float stiffness = d[row], push = -d[row] * x[row];
    if (kind == ONE_SIDED && x[row] >= 0.0f) {
        zone = SATISFIED;
        push = 0.0f;
    } else if (kind == FRICTION) {
        const float most = bound[row], reach = ratio(most, d[row]);
        zone = x[row] <= -reach ? LINEAR_NEGATIVE : x[row] >= reach ? LINEAR_POSITIVE : QUADRATIC;
        push = zone == LINEAR_NEGATIVE ? most : zone == LINEAR_POSITIVE ? -most : push;
    }
    if (zone != QUADRATIC)
        stiffness = 0.0f;
    if (ELLIPTIC && kind == CONE_HEAD) {
        const int end = row + (kinds[row] >> 8);
        const float mu = bound[row], normal = x[row] * mu;
        float tangent2 = 0.0f;
#pragma unroll 1
        for (int mate = row + 1; mate < end; ++mate)
            tangent2 += x[mate] * bound[mate] * x[mate] * bound[mate];
        const float tangent = sqrtf(tangent2);
        zone = cone_zone(normal, tangent, mu);
        float spring = 0.0f;
        if (zone == SATISFIED)
            push = stiffness = 0.0f;
        if (zone == CURVED) {
            const float dm = ratio(d[row], mu * mu * (1.0f + mu * mu));
            push = dm * (mu * tangent - normal) * mu;
            spring = push / tangent;
            stiffness = -dm;
        }
        cones[4 * row] = spring;
#pragma unroll 1
        for (int mate = row + 1; mate < end; ++mate) {
            const float each = zone == QUADRATIC ? d[mate] : spring * bound[mate] * bound[mate];
            force[mate] = -each * x[mate];
            v[mate] = each;
            states[mate] = zone;
        }
    }
    force[row] = push;
    v[row] = stiffness;
    states[row] = zone;
};
// J' force.
auto pull_back = [&] {
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        pull[b] = 0.0f;
        each_row(0, 1, ByFours {}, [&](int row, const float* J) { pull[b] += J[dof_of(b)] * force[row]; });
    }
};
auto add_outer_product = [&](float scale, const float* vector) {
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        const float weight = scale * vector[dof_of(b)];
        if (LANES == 1 && weight == 0.0f)
            continue;
UNROLL
        for (int j = b * LANES; j < NV; ++j)
            h[b][j] += weight * vector[j];
    }
};
// H = M + J' D J. A cone that slides adds, to the springs of its tangents, dm q q' - spring s s', where s is the
// direction of its slip and q = mu (normal - s).
auto build_h = [&] {
UNROLL
    for (int b = 0; b < BLOCKS; ++b)
UNROLL
        for (int j = b * LANES; j < NV; ++j)
            h[b][j] = mass[j * STRIDE + dof_of(b)];
    each_row(0, 1, Singly {}, [&](int row, const float* J) {
        if (v[row] > 0.0f)
            add_outer_product(v[row], J);
    });
    if (!ELLIPTIC)
        return;
    float* const q = columns;
    float* const s = columns + COLUMN;
#pragma unroll 1
    for (int unit = 0; unit < num_units; ++unit) {
        const int head = units[unit];
        const float dm = -v[head];
        if (dm <= 0.0f)
            continue;
        const float mu = bound[head], by_push = -1.0f / force[head];
UNROLL
        for (int b = 0; b < BLOCKS; ++b) {
            float slip = 0.0f;
#pragma unroll 1
            for (int mate = head + 1; mate < head + (kinds[head] >> 8); ++mate)
                slip += force[mate] * row_at(mate)[dof_of(b)];
            slip *= by_push;
            if (is_dof(b)) {
                s[dof_of(b)] = slip;
                q[dof_of(b)] = mu * (row_at(head)[dof_of(b)] - slip);
            }
        }
        sync();
        add_outer_product(dm, q);
        add_outer_product(-cones[4 * head], s);
        sync();
    }
};
// Cholesky (H = L D L') of the rows of H in place, and y of L y = slopes in the place of the slopes.
auto factorize = [&] {
UNROLL
    for (int c = 0; c < NV; ++c) {
        const int own = c / LANES;
        float* const column = columns + (c & 1) * COLUMN;
        if (is_dof(own))
            column[own * LANES + lane] = h[own][c];
        if (lane == c % LANES) {
            column[NV] = bounded(slopes[own]);
UNROLL
            for (int j = (own + 1) * LANES; j < NV; ++j)
                column[j] = h[own][j];
        }
        sync();
        const float by_pivot = 1.0f / wp::max(column[c], TINY);
UNROLL
        for (int b = own; b < BLOCKS; ++b) {
            const int row = b * LANES + lane;
            const float factor = row > c ? (b == own ? h[b][c] : column[dof_of(b)]) * by_pivot : 0.0f;
            if (row == c)
                inverse[b] = by_pivot;
            slopes[b] -= factor * column[NV];
            if (LANES == 1 && factor == 0.0f)
                continue;
UNROLL
            for (int j = wp::max(c + 1, b * LANES); j < NV; ++j)
                h[b][j] -= factor * column[j];
        }
    }
};
// The search direction, the negated solution of D L' x = y, in the place of y and for all lanes to read.
auto back_substitute = [&] {
UNROLL
    for (int c = NV - 1; c > 0; --c) {
        const int own = c / LANES;
        const float found = of_lane(bounded(slopes[own] * inverse[own]), c % LANES);
UNROLL
        for (int b = 0; b <= own; ++b)
            if (b * LANES + lane < c)
                slopes[b] -= h[b][c] * found;
    }
UNROLL
    for (int b = 0; b < BLOCKS; ++b) {
        slopes[b] *= -inverse[b];
        if (is_dof(b))
            shared[dof_of(b)] = bounded(slopes[b]);
    }
    sync();
};
// What the rows cost at a point of the search direction, summed over the units first, first + stride, ...
auto measure = [&](float alpha, int first, int stride) {
    Point sum {0.0f, 0.0f, 0.0f};
#pragma unroll 1
    for (int unit = first; unit < num_units; unit += stride) {
        const int row = units[unit], kind = kinds[row] & 255;
        Point point;
        if (ELLIPTIC && kind == CONE_HEAD)
            point = cone_point(*(const Cone*)(cones + 4 * row), alpha);
        else if (kind == FRICTION)
            point = dry_friction(x[row], v[row], d[row], bound[row], alpha);
        else
            point = one_sided(x[row], v[row], d[row], alpha);
        sum.cost += point.cost;
        sum.slope += point.slope;
        sum.curvature += point.curvature;
    }
    return sum;
};
auto in_bracket = [](const Point& end, const Point& point) {
    return end.slope * point.slope > 0.0f && fabsf(point.slope) < fabsf(end.slope);
};

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

    // The line search keeps two points whose slopes it drives to zero, and takes the better one. Its trials measure three
    // points each, on CUDA by eight lanes each; the first trial is of the start and of the Newton step.
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
        Point sum = measure(mine == 0 ? alphas[0] : mine == 1 ? alphas[1] : alphas[2], mine == 3 ? NJ : lane & 7, 8);
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
            if ((i > 0 || trial >= 0) && fabsf(points[i].slope) < accepted && points[i].cost < (best < 0 ? 0.0f : improvement)) {
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
