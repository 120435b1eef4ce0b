// The body of the function that solves one world; newton_kernel.py gives its arguments and the constants
// NV, NJ, LANES, WORLDS_PER_BLOCK, MOST_TRIALS, ELLIPTIC, and says what it is about.
//
// x is the residual J qacc - aref of a row, v its rate J search, d its stiffness. Loops are not unrolled unless that hides
// the latency of loads: the lanes of many worlds are in different places of this code at once, and it has to stay in the
// instruction cache.

constexpr int EQUALITY = 0, FRICTION = 1, ONE_SIDED = 2, CONE_HEAD = 3, CONE_TANGENT = 4;
constexpr int SATISFIED = 0, QUADRATIC = 1, LINEAR_NEGATIVE = 2, LINEAR_POSITIVE = 3, CURVED = 4;
constexpr int ELLIPTIC_CONTACT = 7;
constexpr float TINY = 1e-15f;
constexpr float NOISE = 8.0f * 1.1920929e-07f;  // rounding of a sum of some float32 terms
constexpr float IS_CURVED = -1.0f;              // in the place of a stiffness
constexpr int SIZE = FLOATS;

#if defined(__CUDA_ARCH__)
__shared__ float floats[WORLDS_PER_BLOCK * SIZE];
float* const memory = floats + (threadIdx.x / LANES) * SIZE;
#else
static float memory[SIZE];
#endif
float* const h = memory;  // the lower triangle of H, and below it b, which becomes the y of L y = b
float* const acc = h + (NV + 1) * (NV + 2) / 2;
float* const ma = acc + NV;
float* const search = ma + NV;
float* const mv = search + NV;
float* const qfrc = mv + NV;
float* const inverse_diag = qfrc + NV;
float* const x = inverse_diag + NV;
float* const v = x + NJ;  // between two line searches: the stiffness of the row, 0 where it is slack
float* const force = v + NJ;
float* const d = force + NJ;
int* const kinds = (int*)(d + NJ);
float* const cones = (float*)(kinds + NJ);

const float* const J = J_values.data + (size_t)world * J_values.shape[1];
const int* const J_col = J_colind.data + (size_t)world * J_colind.shape[1];
const int* const J_adr = J_rowadr.data + (size_t)world * J_rowadr.shape[1];
const int* const J_nnz = J_rownnz.data + (size_t)world * J_rownnz.shape[1];
const float* const mass = M.data + (size_t)world * M.shape[1];
const float* const smooth = qfrc_smooth.data + (size_t)world * qfrc_smooth.shape[1];
const float* const limit = efc_limit.data + (size_t)world * efc_limit.shape[1];
const int* const ids = efc_id.data + (size_t)world * efc_id.shape[1];
const int* const heads = group_head.data + (size_t)world * group_head.shape[1];
const int* const sizes = group_size.data + (size_t)world * group_size.shape[1];
const int* const friction_row = dof_friction_row.data + (size_t)world * dof_friction_row.shape[1];
int* const states = efc_state.data + (size_t)world * efc_state.shape[1];

const int equalities = ne.data[world], frictions = nf.data[world];
const int rows = wp::min(nefc.data[world], NJ), groups = num_groups.data[world];
const float impratio = impratio_invsqrt.data[world % impratio_invsqrt.shape[0]];
const float tolerance = tolerances.data[world % tolerances.shape[0]];
const float ls_tolerance = ls_tolerances.data[world % ls_tolerances.shape[0]];

auto sync = [] {
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
};
auto total = [](float value) {
#if defined(__CUDA_ARCH__)
#pragma unroll
    for (int distance = LANES / 2; distance > 0; distance >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, distance);
#endif
    return value;
};
auto ratio = [](float a, float b) { return a / (b == 0.0f ? TINY : b); };
auto packed = [](int row, int col) { return row * (row + 1) / 2 + col; };

struct Point {
    float cost, slope, curvature, start;  // the cost is relative to that at the start of the direction
};
struct Cone {
    float mu, u0, v0, along, speed, aside2, dm, cost, slope, half_curvature, tangent, zone;
};
auto cone_zone = [](float normal, float tangent, float mu) {
    return normal >= mu * tangent ? SATISFIED : mu * normal + tangent <= 0.0f ? QUADRATIC : CURVED;
};
// The friction coefficients of the contact of a row, and how the first scales with impratio.
auto friction_of = [&](int row) { return (const float*)(contact_friction.data + ids[row]); };

auto one_sided = [](float x, float v, float d, float alpha) {
    const float slope = d * v * x, curvature = d * v * v, start = x < 0.0f ? 0.5f * d * x * x : 0.0f;
    if (x + alpha * v >= 0.0f && !(alpha == 0.0f && x < 0.0f))
        return Point {-start, 0.0f, 0.0f, start};
    const float change = alpha * (slope + 0.5f * alpha * curvature);
    return Point {x < 0.0f ? change : change + 0.5f * d * x * x, slope + alpha * curvature, curvature, start};
};
auto dry_friction = [&](float x, float v, float d, float most, float alpha) {
    const float reach = ratio(most, d);
    auto cost = [&](float at) {
        return at <= -reach ? most * (-0.5f * reach - at) : at >= reach ? most * (-0.5f * reach + at) : 0.5f * d * at * at;
    };
    const float there = x + alpha * v, start = cost(x);
    const bool linear = there <= -reach || there >= reach;
    const float slope = there <= -reach ? -most * v : there >= reach ? most * v : d * v * there;
    return Point {cost(there) - start, slope, linear ? 0.0f : d * v * v, start};
};
auto cone_point = [&](const Cone& c, float alpha) {
    const int zone0 = (int)c.zone;
    const float gap0 = c.u0 - c.mu * c.tangent;
    const float start = zone0 == CURVED ? 0.5f * c.dm * gap0 * gap0 : zone0 == QUADRATIC ? c.cost : 0.0f;
    const float normal = c.u0 + alpha * c.v0, ahead = c.along + alpha * c.speed;
    const float tangent2 = ahead * ahead + c.aside2, tangent = sqrtf(tangent2);
    const int zone = cone_zone(normal, tangent, c.mu);
    if (zone == SATISFIED)
        return Point {-start, 0.0f, 0.0f, start};
    // The quadratic cost of all rows exceeds that of the cone at the same point by dm / 2 (mu N + T)^2.
    const float half = alpha * c.half_curvature, quadratic = alpha * (half + c.slope);
    if (zone == QUADRATIC) {
        const float excess = c.mu * c.u0 + c.tangent;
        const float change = zone0 == CURVED ? quadratic + 0.5f * c.dm * excess * excess
            : zone0 == SATISFIED ? 0.5f * c.dm * (1.0f + c.mu * c.mu) * (normal * normal + tangent2) : quadratic;
        return Point {change, 2.0f * half + c.slope, 2.0f * c.half_curvature, start};
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
    return Point {change, c.dm * gap * gap_rate, c.dm * (gap_rate * gap_rate - c.mu * gap * bend), start};
};
// What the rows cost at a point of the search direction, summed over the rows first, first + stride, ...
auto measure = [&](float alpha, int first, int stride) {
    Point sum {0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll 1
    for (int row = equalities + first; row < rows; row += stride) {
        const int kind = kinds[row] & 255;
        if (kind == CONE_TANGENT)
            continue;
        Point point;
        if (ELLIPTIC && kind == CONE_HEAD)
            point = cone_point(*(const Cone*)(cones + 4 * row), alpha);
        else if (kind == FRICTION)
            point = dry_friction(x[row], v[row], d[row], limit[row], alpha);
        else
            point = one_sided(x[row], v[row], d[row], alpha);
        sum.cost += point.cost;
        sum.slope += point.slope;
        sum.curvature += point.curvature;
        sum.start += point.start;
    }
    return sum;
};
auto prepare_cone = [&](int head, int size) {
    const float* const friction = friction_of(head);
    Cone& c = *(Cone*)(cones + 4 * head);
    c.mu = friction[0] * impratio;
    c.dm = ratio(d[head], c.mu * c.mu * (1.0f + c.mu * c.mu));
    c.cost = c.slope = c.half_curvature = 0.0f;
    float uu = 0.0f, uv = 0.0f, vv = 0.0f, aside = 0.0f;
#pragma unroll 1
    for (int k = 0; k < size; ++k) {
        const int row = head + k;
        c.cost += 0.5f * d[row] * x[row] * x[row];
        c.slope += d[row] * x[row] * v[row];
        c.half_curvature += 0.5f * d[row] * v[row] * v[row];
        if (k == 0)
            continue;
        const float u_k = x[row] * friction[k - 1], v_k = v[row] * friction[k - 1];
        uu += u_k * u_k;
        uv += u_k * v_k;
        vv += v_k * v_k;
        // |u|^2 |v|^2 - (u v)^2 as a sum of squares: nothing cancels.
#pragma unroll 1
        for (int j = 1; j < k; ++j) {
            const float minor = (u_k * v[head + j] - x[head + j] * v_k) * friction[j - 1];
            aside += minor * minor;
        }
    }
    c.speed = sqrtf(vv);
    c.along = vv > 0.0f ? uv / c.speed : 0.0f;
    c.aside2 = vv > 0.0f ? aside / vv : uu;
    c.u0 = x[head] * c.mu;
    c.v0 = v[head] * c.mu;
    c.tangent = sqrtf(c.along * c.along + c.aside2);
    c.zone = (float)cone_zone(c.u0, c.tangent, c.mu);
};
// The force of a row, and its stiffness in the place of its rate.
auto push = [&](int row) {
    const int kind = kinds[row] & 255;
    if (kind == CONE_TANGENT)
        return;
    int zone = QUADRATIC;
    float pull = -d[row] * x[row];
    if (kind == ONE_SIDED && x[row] >= 0.0f) {
        zone = SATISFIED;
        pull = 0.0f;
    } else if (kind == FRICTION) {
        const float most = limit[row], reach = ratio(most, d[row]);
        zone = x[row] <= -reach ? LINEAR_NEGATIVE : x[row] >= reach ? LINEAR_POSITIVE : QUADRATIC;
        pull = zone == LINEAR_NEGATIVE ? most : zone == LINEAR_POSITIVE ? -most : pull;
    } else if (ELLIPTIC && kind == CONE_HEAD) {
        const float* const friction = friction_of(row);
        const int size = kinds[row] >> 8;
        const float mu = friction[0] * impratio, normal = x[row] * mu;
        float tangent2 = 0.0f;
#pragma unroll 1
        for (int k = 1; k < size; ++k)
            tangent2 += x[row + k] * friction[k - 1] * x[row + k] * friction[k - 1];
        const float tangent = sqrtf(tangent2);
        zone = cone_zone(normal, tangent, mu);
        if (zone != QUADRATIC)
            pull = zone == SATISFIED ? 0.0f : -ratio(d[row], mu * mu * (1.0f + mu * mu)) * (normal - mu * tangent) * mu;
        const float slide = zone == CURVED ? -ratio(pull, tangent) : 0.0f;
#pragma unroll 1
        for (int k = 1; k < size; ++k) {
            const int mate = row + k;
            force[mate] = zone == QUADRATIC ? -d[mate] * x[mate] : slide * x[mate] * friction[k - 1] * friction[k - 1];
            v[mate] = zone == QUADRATIC ? d[mate] : 0.0f;
            states[mate] = zone;
        }
    }
    force[row] = pull;
    v[row] = zone == QUADRATIC ? d[row] : zone == CURVED ? IS_CURVED : 0.0f;
    states[row] = zone;
};
auto times_mass = [&](float* result, const float* vector) {
#pragma unroll 1
    for (int i = lane; i < NV; i += LANES) {
        float product = 0.0f;
#pragma unroll 4
        for (int k = mulm_rowadr.data[i]; k < mulm_rowadr.data[i + 1]; ++k)
            product += mass[mulm_adr.data[k]] * vector[mulm_col.data[k]];
        result[i] = product;
    }
};
auto times_row = [&](int row, const float* vector) {
    const int at = J_adr[row], end = at + J_nnz[row];
    float product = 0.0f;
#pragma unroll 4
    for (int k = at; k < end; ++k)
        product += J[k] * vector[J_col[k]];
    return product;
};
// J' force. The rows of a group share their columns, and no two groups are added at once.
auto pull_back = [&] {
#pragma unroll 1
    for (int i = lane; i < NV; i += LANES) {
        const int row = frictions > 0 ? friction_row[i] : -1;
        qfrc[i] = row >= 0 ? force[row] : 0.0f;
    }
    sync();
#pragma unroll 1
    for (int group = 0; group < groups; ++group) {
        const int head = heads[group], size = sizes[group], at = J_adr[head], support = J_nnz[head];
#pragma unroll 1
        for (int k = lane; k < support; k += LANES) {
            float pull = 0.0f;
#pragma unroll 2
            for (int mate = 0; mate < size; ++mate)
                pull += force[head + mate] * J[at + mate * support + k];
            qfrc[J_col[at + k]] += pull;
        }
        sync();
    }
};
// H = M + J' D J, and the curvature of the cones that slide.
auto build_h = [&] {
#pragma unroll 1
    for (int i = lane; i < NV * (NV + 1) / 2; i += LANES)
        h[i] = 0.0f;
    sync();
#pragma unroll 2
    for (int k = lane; k < M_row.shape[0]; k += LANES)
        h[packed(M_row.data[k], M_col.data[k])] = mass[k];
    sync();
    if (frictions > 0) {
#pragma unroll 1
        for (int i = lane; i < NV; i += LANES)
            if (friction_row[i] >= 0)
                h[packed(i, i)] += v[friction_row[i]];
        sync();
    }
#pragma unroll 1
    for (int group = 0; group < groups; ++group) {
        const int head = heads[group], size = sizes[group];
        const bool curved = ELLIPTIC && v[head] == IS_CURVED;
        bool active = curved;
#pragma unroll 1
        for (int mate = 0; mate < size; ++mate)
            active = active || v[head + mate] != 0.0f;
        if (!active)
            continue;
        const int at = J_adr[head], support = J_nnz[head];
        const float* friction = 0;
        float mu = 0.0f, dm = 0.0f, flat = 0.0f, stretch = 0.0f, per_tangent = 0.0f;
        if (ELLIPTIC && curved) {
            friction = friction_of(head);
            mu = friction[0] * impratio;
            dm = ratio(d[head], mu * mu * (1.0f + mu * mu));
            float tangent2 = 0.0f;
#pragma unroll 1
            for (int k = 1; k < size; ++k)
                tangent2 += x[head + k] * friction[k - 1] * x[head + k] * friction[k - 1];
            per_tangent = 1.0f / wp::max(sqrtf(tangent2), TINY);
            stretch = mu * x[head] * mu * per_tangent;
            flat = mu * mu - stretch;
        }
#pragma unroll 1
        for (int entry = lane; entry < support * (support + 1) / 2; entry += LANES) {
            const int b = (int)((sqrtf((float)(8 * entry + 1)) - 1.0f) * 0.5f), a = entry - b * (b + 1) / 2;
            float value = 0.0f;
            if (ELLIPTIC && curved) {
                const float normal_a = mu * J[at + a], normal_b = mu * J[at + b];
                float slide_a = 0.0f, slide_b = 0.0f, dot = 0.0f;
#pragma unroll 1
                for (int k = 1; k < size; ++k) {
                    const float z_a = friction[k - 1] * J[at + k * support + a];
                    const float z_b = friction[k - 1] * J[at + k * support + b];
                    const float u = x[head + k] * friction[k - 1] * per_tangent;
                    slide_a += u * z_a;
                    slide_b += u * z_b;
                    dot += z_a * z_b;
                }
                value = dm * (normal_a * normal_b - mu * (normal_a * slide_b + normal_b * slide_a)
                              + stretch * slide_a * slide_b + flat * dot);
            } else {
#pragma unroll 2
                for (int mate = 0; mate < size; ++mate)
                    value += v[head + mate] * J[at + mate * support + a] * J[at + mate * support + b];
            }
            const int dof_a = J_col[at + a], dof_b = J_col[at + b];
            h[packed(wp::max(dof_a, dof_b), wp::min(dof_a, dof_b))] += value;
        }
        sync();
    }
};
// Cholesky. A lane owns a row at a time, and all lanes know the diagonal.
auto factorize = [&] {
#pragma unroll 1
    for (int col = 0; col < NV; ++col) {
        const float* const left = h + packed(col, 0);
        float* below = h + packed(wp::min(col + 1 + lane, NV), 0);
        float diag = left[col], entry = below[col];
#pragma unroll 4
        for (int k = 0; k < col; ++k) {
            const float across = left[k];
            diag -= across * across;
            // What overflows in one tree stays there: infinity times zero would be NaN.
            entry -= across == 0.0f ? 0.0f : below[k] * across;
        }
        const float inverse = 1.0f / sqrtf(wp::max(diag, TINY));
        if (col + 1 + lane <= NV)
            below[col] = entry * inverse;
#pragma unroll 1
        for (int row = col + 1 + lane + LANES; row <= NV; row += LANES) {
            below = h + packed(row, 0);
            entry = below[col];
#pragma unroll 4
            for (int k = 0; k < col; ++k)
                entry -= left[k] == 0.0f ? 0.0f : below[k] * left[k];
            below[col] = entry * inverse;
        }
        if (lane == 0)
            inverse_diag[col] = inverse;
        sync();
    }
};
// The negated x of L' x = y.
auto back_substitute = [&] {
    float* const y = h + packed(NV, 0);
#pragma unroll 1
    for (int row = NV - 1; row >= 0; --row) {
        const float found = y[row] * inverse_diag[row];
        const float* const left = h + packed(row, 0);
#pragma unroll 1
        for (int k = lane; k < row; k += LANES)
            if (left[k] != 0.0f)
                y[k] -= left[k] * found;
        if (lane == 0)
            search[row] = -found;
        sync();
    }
};
auto in_bracket = [](const Point& end, const Point& point) {
    return (end.slope < point.slope && point.slope < 0.0f) || (end.slope > point.slope && point.slope > 0.0f);
};

// The start: the last acceleration, what it needs, and how far it is from the reference.
float trace = 0.0f;
#pragma unroll 1
for (int i = lane; i < NV; i += LANES) {
    acc[i] = warmstart.data[(size_t)world * warmstart.shape[1] + i];
    trace += mass[M_rowadr.data[i] + M_rownnz.data[i] - 1];
}
sync();
const float scale = 1.0f / wp::max(TINY, total(trace));
times_mass(ma, acc);
#pragma unroll 1
for (int row = lane; row < rows; row += LANES) {
    x[row] = times_row(row, acc) - efc_aref.data[(size_t)world * efc_aref.shape[1] + row];
    d[row] = efc_D.data[(size_t)world * efc_D.shape[1] + row];
    int kind = row < equalities ? EQUALITY : row < equalities + frictions ? FRICTION : ONE_SIDED;
    if (ELLIPTIC && efc_type.data[(size_t)world * efc_type.shape[1] + row] == ELLIPTIC_CONTACT)
        kind = CONE_TANGENT;
    kinds[row] = kind;
}
sync();
if (ELLIPTIC) {
#pragma unroll 1
    for (int group = lane; group < groups; group += LANES)
        if (kinds[heads[group]] == CONE_TANGENT)
            kinds[heads[group]] = CONE_HEAD + (sizes[group] << 8);
    sync();
}

int iteration = 0;
bool last = false;
while (true) {
#pragma unroll 1
    for (int row = lane; row < rows; row += LANES)
        push(row);
    sync();
    pull_back();
    float gradient2 = 0.0f;
#pragma unroll 1
    for (int i = lane; i < NV; i += LANES) {
        const float slope = ma[i] - smooth[i] - qfrc[i];
        h[packed(NV, i)] = slope;
        gradient2 += slope * slope;
    }
    if (last || (iteration > 0 && scale * sqrtf(total(gradient2)) < tolerance))
        break;
    build_h();
    factorize();
    float decrement = 0.0f;
#pragma unroll 1
    for (int i = lane; i < NV; i += LANES)
        decrement += h[packed(NV, i)] * h[packed(NV, i)];
    if (iteration > 0 && 0.5f * scale * total(decrement) < tolerance)
        break;
    if (iteration == iterations) {
        if (lane == 0)
            overflow.data[world] |= OUT_OF_ITERATIONS;
        break;
    }
    sync();
    back_substitute();
    times_mass(mv, search);
    float search2 = 0.0f, slope = 0.0f, half_curvature = 0.0f;
#pragma unroll 1
    for (int i = lane; i < NV; i += LANES) {
        search2 += search[i] * search[i];
        slope += search[i] * (ma[i] - smooth[i]);
        half_curvature += 0.5f * search[i] * mv[i];
    }
#pragma unroll 1
    for (int row = lane; row < rows; row += LANES) {
        const float rate = times_row(row, search);
        v[row] = rate;
        if (row < equalities) {
            slope += d[row] * rate * x[row];
            half_curvature += 0.5f * d[row] * rate * rate;
        }
    }
    sync();
    search2 = total(search2);
    slope = total(slope);
    half_curvature = total(half_curvature);
    if (ELLIPTIC) {
#pragma unroll 1
        for (int row = lane; row < rows; row += LANES)
            if ((kinds[row] & 255) == CONE_HEAD)
                prepare_cone(row, kinds[row] >> 8);
        sync();
    }

    // The line search keeps two points whose slopes it drives to zero, and takes the better one. Its trials measure three
    // points each, on CUDA by eight lanes each; the first two trials are the start and the Newton step.
    const float enough = wp::max(tolerance * ls_tolerance * sqrtf(search2) / scale, 1e-6f);
    float alpha = rows == 0 ? 1.0f : 0.0f, improvement = 0.0f, accepted = enough;
    float alphas[3] = {0.0f, 0.0f, 0.0f}, low_alpha = 0.0f, high_alpha = 0.0f;
    Point low {0.0f, 0.0f, 0.0f, 0.0f}, high = low;
#pragma unroll 1
    for (int trial = -2; rows > 0; ++trial) {
        if (trial == MOST_TRIALS) {
            if (lane == 0)
                overflow.data[world] |= OUT_OF_LS_ITERATIONS;
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
        const float alpha_of_mine = mine == 0 ? alphas[0] : mine == 1 ? alphas[1] : alphas[2];
        Point sum = measure(alpha_of_mine, mine == 3 ? NJ : lane & 7, 8);
#pragma unroll
        for (int distance = 4; distance > 0; distance >>= 1) {
            sum.cost += __shfl_xor_sync(0xffffffffu, sum.cost, distance);
            sum.slope += __shfl_xor_sync(0xffffffffu, sum.slope, distance);
            sum.curvature += __shfl_xor_sync(0xffffffffu, sum.curvature, distance);
            sum.start += __shfl_xor_sync(0xffffffffu, sum.start, distance);
        }
#endif
#pragma unroll
        for (int i = 0; i < 3; ++i) {
#if defined(__CUDA_ARCH__)
            points[i].cost = __shfl_sync(0xffffffffu, sum.cost, 8 * i);
            points[i].slope = __shfl_sync(0xffffffffu, sum.slope, 8 * i);
            points[i].curvature = __shfl_sync(0xffffffffu, sum.curvature, 8 * i);
            points[i].start = __shfl_sync(0xffffffffu, sum.start, 0);
#else
            points[i] = measure(alphas[i], 0, 1);
#endif
            points[i].cost += alphas[i] * (alphas[i] * half_curvature + slope);
            points[i].slope += 2.0f * alphas[i] * half_curvature + slope;
            points[i].curvature += 2.0f * half_curvature;
        }
        if (trial == -2) {
            low = high = points[0];
            const float gross = sqrtf(2.0f * wp::max(low.start, 0.0f) * wp::max(low.curvature - 2.0f * half_curvature, 0.0f))
                + fabsf(slope);
            accepted = wp::max(enough, NOISE * gross);
            if (fabsf(low.slope) < NOISE * gross)
                break;
            alphas[0] = alphas[1] = alphas[2] = -ratio(low.slope, low.curvature);
            continue;
        }
        int best = -1;
#pragma unroll
        for (int i = 0; i < 3; ++i)
            if (fabsf(points[i].slope) < accepted && points[i].cost < (best < 0 ? 0.0f : improvement)) {
                best = i;
                improvement = points[i].cost;
                alpha = alphas[i];
            }
        if (best >= 0) {
            improvement = -improvement;
            break;
        }
        if (trial == -1) {
            if (points[0].slope < low.slope) {
                low = points[0];
                low_alpha = alphas[0];
            } else {
                high = points[0];
                high_alpha = alphas[0];
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

#pragma unroll 1
    for (int i = lane; i < NV; i += LANES) {
        acc[i] += alpha * search[i];
        ma[i] += alpha * mv[i];
    }
#pragma unroll 1
    for (int row = lane; row < rows; row += LANES)
        x[row] += alpha * v[row];
    sync();
    ++iteration;
    last = rows == 0 || alpha == 0.0f || (improvement > 0.0f && scale * improvement < tolerance);
}

#pragma unroll 1
for (int i = lane; i < NV; i += LANES) {
    qacc.data[(size_t)world * qacc.shape[1] + i] = acc[i];
    efc_Ma.data[(size_t)world * efc_Ma.shape[1] + i] = ma[i];
    qfrc_constraint.data[(size_t)world * qfrc_constraint.shape[1] + i] = qfrc[i];
}
#pragma unroll 1
for (int row = lane; row < rows; row += LANES)
    efc_force.data[(size_t)world * efc_force.shape[1] + row] = force[row];
if (lane == 0)
    solver_niter.data[world] = iteration;
