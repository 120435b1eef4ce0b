// The second part: what the constraint rows cost, at the present acceleration and along the search direction.
// x is the residual J qacc - aref of a row, v its rate J search, d its stiffness.

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
        return fabsf(at) >= reach ? most * (fabsf(at) - 0.5f * reach) : 0.5f * d * at * at;
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
            : zone0 == SATISFIED ? 0.5f * c.dm * (1.0f + c.mu * c.mu) * (normal * normal + tangent2)
            : quadratic;
        return Point {change, 2.0f * half + c.slope, 2.0f * c.half_curvature};
    }
    const float gap = normal - c.mu * tangent;
    const float gap_rate = c.v0 - c.mu * ahead * c.speed / tangent;
    const float bend = (c.aside2 / tangent2) * (c.speed * c.speed / tangent);
    float change = 0.5f * c.dm * gap * gap;
    if (zone0 == CURVED) {  // T - T0 from T^2 - T0^2, which is small by itself
        const float lengthening = alpha * c.speed * (c.along + ahead) / (tangent + c.tangent);
        const float further = alpha * c.v0 - c.mu * lengthening;
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
