// Where two shapes touch, or how far they are apart. The sources are engine_collision_primitive.c and, of boxes,
// engine_collision_box.c. A pair has several of them, of which a lane finds one at a time. Normals point from the first geom to the second.
#pragma once
#include "ksim_rl/physics/collision/broad_phase.cuh"

namespace collisions {

constexpr float FAR = 1e10f;
struct Touch {
    float distance = FAR;
    vec3 position, normal;
};

CUDA_CALLABLE inline float sign_of(int bits, int bit)
{
    return bits >> bit & 1 ? 1.0f : -1.0f;
}

CUDA_CALLABLE inline vec3 into(const wp::mat33& turn, const vec3& v)
{
    return vec3(
        turn.data[0][0] * v[0] + turn.data[1][0] * v[1] + turn.data[2][0] * v[2],
        turn.data[0][1] * v[0] + turn.data[1][1] * v[1] + turn.data[2][1] * v[2],
        turn.data[0][2] * v[0] + turn.data[1][2] * v[1] + turn.data[2][2] * v[2]
    );
}

CUDA_CALLABLE inline Touch plane_touches(const vec3& normal, const vec3& origin, const vec3& point, float radius)
{
    const float distance = wp::dot(point - origin, normal) - radius;
    return Touch{distance, point - normal * (radius + 0.5f * distance), normal};
}

CUDA_CALLABLE inline Touch spheres_touch(const vec3& center, float radius, const vec3& other, float other_radius)
{
    const vec3 between = other - center;
    const float length = wp::length(between), distance = length - radius - other_radius;
    const vec3 normal = length > 0.0f ? between / length : vec3(1.0f, 0.0f, 0.0f);
    return Touch{distance, center + normal * (radius + 0.5f * distance), normal};
}

// The point in the middle is `center` in the axes of the box.
CUDA_CALLABLE inline Touch sphere_touches_box(const vec3& center, float radius, const vec3& size, const vec3& origin, const wp::mat33& turn)
{
    vec3 outwards, nearest;
    for (int i = 0; i < 3; ++i) {
        nearest[i] = wp::clamp(center[i], -size[i], size[i]);
        outwards[i] = nearest[i] - center[i];
    }
    float distance = wp::length(outwards);
    vec3 normal = outwards / distance;
    if (distance <= 1e-15f) {
        // Out through the nearest face.
        float least = FAR;
        for (int face = 0; face < 6; ++face) {
            const float side = face % 2 ? 1.0f : -1.0f, depth = wp::abs(side * size[face / 2] - center[face / 2]);
            if (depth < least) {
                least = depth;
                normal = vec3();
                normal[face / 2] = -side;
            }
        }
        distance = -least;
    }
    // Half way between the surfaces.
    const vec3 middle = center + normal * (0.5f * (distance + radius));
    return Touch{distance - radius, origin + wp::mul(turn, middle), wp::mul(turn, normal)};
}

// Two segments are nearest each other at center + s * half and other + t * other_half, of -1 to 1 each. Parallel ones are
// at both ends of where they overlap; the second of these is asked for by `second`.
CUDA_CALLABLE inline Touch capsules_touch(const Geoms& geoms, int a, int b, bool second)
{
    const vec3 half = axis(geoms.turns[a], 2) * geoms.sizes[a][1], other_half = axis(geoms.turns[b], 2) * geoms.sizes[b][1];
    const vec3 between = geoms.positions[a] - geoms.positions[b], normal = wp::cross(half, other_half);
    const float aa = wp::dot(half, half), bb = wp::dot(other_half, other_half), ab = wp::dot(half, other_half);
    const float a_between = wp::dot(half, between), b_between = wp::dot(other_half, between);
    const float sines = wp::dot(normal, normal);
    const bool parallel = !(sines > 1e-8f * aa * bb);
    if (second && (!parallel || aa < 1e-15f || bb < 1e-15f))
        return Touch();
    // Where the other's end, t, is nearest to, and where the end s is.
    auto of_other = [&](float t) { return aa > 1e-15f ? wp::clamp((ab * t - a_between) / aa, -1.0f, 1.0f) : 0.0f; };
    float s = second ? 1.0f : -1.0f;
    if (!parallel)
        s = wp::clamp(wp::dot(normal, wp::cross(other_half, between)) / sines, -1.0f, 1.0f);
    else if (bb < 1e-15f)
        s = of_other(0.0f);
    else if (aa < 1e-15f)
        s = 0.0f;
    float t = bb > 1e-15f ? (ab * s + b_between) / bb : 0.0f;
    if (wp::abs(t) > 1.0f) {
        t = t > 0.0f ? 1.0f : -1.0f;
        s = of_other(t);
    }
    return spheres_touch(geoms.positions[a] + half * s, geoms.sizes[a][0], geoms.positions[b] + other_half * t, geoms.sizes[b][0]);
}

// A capsule touches a box where they are nearest, and where it leaves what it lies along, a face or an edge.
CUDA_CALLABLE inline Touch capsule_touches_box(const Geoms& geoms, int a, int b, bool second)
{
    const wp::mat33 turn = geoms.turns[b];
    const vec3 size = geoms.sizes[b], direction = into(turn, axis(geoms.turns[a], 2)), half = direction * geoms.sizes[a][1];
    const vec3 center = into(turn, geoms.positions[a] - geoms.positions[b]);
    float least = FAR, s = 0.0f, along_edge = 0.0f;
    int face = -1, corner = -1, edge = 0;  // of the box: the face, or else the corner or the edge from it, that is nearest
    bool found = false, at_corner = false;
    for (int end = -1; end <= 1; end += 2) {
        const vec3 tip = center + half * (float)end;
        int outside = 0, side = -1;
        float distance = 0.0f;
        for (int i = 0; i < 3; ++i) {
            const float beyond = wp::abs(tip[i]) - size[i];
            if (beyond > 0.0f) {
                ++outside;
                side = i;
                distance += beyond * beyond;
            }
        }
        if (outside <= 1 && distance < least) {
            least = distance;
            s = (float)end;
            face = side;
            found = true;
        }
    }
    // In this order C takes the first of edges that are equally near.
    for (int item = 0; item < 24; ++item) {
        const int lower = item / 3, j = item % 3, k = (j + 1) % 3, l = (j + 2) % 3;
        if (lower >> j & 1)
            continue;
        vec3 between = -center;
        between[k] += sign_of(lower, k) * size[k];
        between[l] += sign_of(lower, l) * size[l];
        const float u = -size[j] * between[j], v = wp::dot(half, between), uu = size[j] * size[j];
        const float uv = -size[j] * half[j], vv = wp::dot(half, half), determinant = uu * vv - uv * uv;
        if (wp::abs(determinant) < 1e-15f)
            continue;
        float x = (vv * u - uv * v) / determinant, y = (uu * v - uv * u) / determinant;
        int end = 0;  // of the edge
        auto stop_at_ends = [&] {
            if (wp::abs(x) > 1.0f)
                x = (float)(end = x > 0.0f ? 1 : -1);
        };
        stop_at_ends();
        if (end != 0)
            y = (v - uv * x) / vv;
        if (wp::abs(y) > 1.0f) {
            y = y > 0.0f ? 1.0f : -1.0f;
            x = (u - uv * y) / uu;
            stop_at_ends();
        }
        vec3 gap = between - half * y;
        gap[j] += size[j] * x;
        const float distance = wp::dot(gap, gap);
        if (distance < least - 1e-15f) {
            least = distance;
            s = y;
            along_edge = x;
            at_corner = end != 0;
            corner = lower | (end > 0) << j;
            edge = j;
            found = true;
        }
    }
    if (!found)
        return Touch();
    if (!second)
        return sphere_touches_box(center + half * s, geoms.sizes[a][0], size, geoms.positions[b], turn);
    // How far the second is from the first, and to which side.
    const int upwards = (half[0] > 0.0f) | (half[1] > 0.0f) << 1 | (half[2] > 0.0f) << 2;
    auto is_one_axis = [](int bits) { return bits == 1 || bits == 2 || bits == 4; };
    auto span = [&](int i) { return size[i] / wp::abs(half[i]); };
    float further = 0.0f, side = 1.0f;
    if (corner < 0) {
        if (face < 0)
            return Touch();
        side = -s;
        further = 2.0f;
        for (int i = 0; i < 3; ++i)
            for (int wall = 0; wall < 2; ++wall) {
                const float until = (sign_of(wall, 0) * size[i] - (center[i] + half[i] * s)) * (side / half[i]);
                if (i != face && until > 0.0f && until < further)
                    further = until;
            }
    } else if (at_corner) {
        int apart = upwards ^ corner;
        if (apart == 0 || apart == 7)
            return Touch();
        if (!is_one_axis(apart)) {
            side = -1.0f;
            apart = 7 - apart;
        }
        const int i = apart / 2;  // 1, 2, 4
        if (direction[i] * direction[i] > 0.5f)
            further = wp::min(1.0f - side * s, 2.0f * span(i));
        else
            further = -wp::min(1.0f + side * s, 2.0f * wp::min(span((i + 1) % 3), span((i + 2) % 3)));
    } else {
        const int apart = (upwards ^ corner) & ~(1 << edge);
        if (!is_one_axis(apart))
            return Touch();
        int across = (edge + 1) % 3;
        const int other = (edge + 2) % 3;
        // Along the face that it is flatter on.
        if (wp::abs(direction[across]) <= wp::abs(direction[other]))
            across = other;
        const bool forwards = apart >> across & 1;
        side = forwards ? 1.0f : -1.0f;
        const float rest = (bool)(upwards >> edge & 1) == forwards ? 1.0f - along_edge : 1.0f + along_edge;
        further = wp::min(wp::min(1.0f - side * s, 2.0f * span(across)), rest * span(edge));
    }
    return sphere_touches_box(center + half * (s + side * further), geoms.sizes[a][0], size, geoms.positions[b], turn);
}

// The lowest points of both ends of a cylinder, then two more of the lower end, which make a triangle with its lowest.
CUDA_CALLABLE inline Touch cylinder_touches_plane(const Geoms& geoms, int a, int b, int which)
{
    const vec3 normal = axis(geoms.turns[a], 2), center = geoms.positions[b];
    const float radius = geoms.sizes[b][0];
    vec3 down = axis(geoms.turns[b], 2);
    if (wp::dot(down, normal) > 0.0f)
        down = -down;
    vec3 lowest = down * wp::dot(down, normal) - normal;
    const float length = wp::length(lowest);
    lowest = length >= 1e-6f ? lowest * (radius / length) : axis(geoms.turns[b], 0) * radius;
    down = down * geoms.sizes[b][1];
    if (which < 2)
        return plane_touches(normal, geoms.positions[a], center + lowest + down * (which ? -1.0f : 1.0f), 0.0f);
    const vec3 aside = wp::normalize(wp::cross(lowest, down)) * (radius * 0.8660254f * (which == 2 ? 1.0f : -1.0f));
    return plane_touches(normal, geoms.positions[a], center + down - lowest * 0.5f + aside, 0.0f);
}

CUDA_CALLABLE inline Touch touch_of(const Geoms& geoms, int a, int b, int which)
{
    const int kind = geoms.a.geom_type.data[a], other = geoms.a.geom_type.data[b];
    const vec3 size = geoms.sizes[b], along = axis(geoms.turns[b], 2);
    if (kind == PLANE) {
        const vec3 normal = axis(geoms.turns[a], 2);
        if (other == CYLINDER)
            return cylinder_touches_plane(geoms, a, b, which);
        if (other == SPHERE)
            return plane_touches(normal, geoms.positions[a], geoms.positions[b], size[0]);
        if (other == CAPSULE)
            return plane_touches(normal, geoms.positions[a], geoms.positions[b] + along * (which ? -size[1] : size[1]), size[0]);
        const vec3 corner = wp::mul(
            geoms.turns[b], vec3(sign_of(which, 0) * size[0], sign_of(which, 1) * size[1], sign_of(which, 2) * size[2])
        );
        // The other half of the corners is above the center.
        return wp::dot(corner, normal) > 0.0f ? Touch() : plane_touches(normal, geoms.positions[a], geoms.positions[b] + corner, 0.0f);
    }
    if (kind == SPHERE && other == BOX)
        return sphere_touches_box(
            into(geoms.turns[b], geoms.positions[a] - geoms.positions[b]), geoms.sizes[a][0], size, geoms.positions[b], geoms.turns[b]
        );
    if (kind == SPHERE) {
        const float place = other == CAPSULE ? wp::dot(along, geoms.positions[a] - geoms.positions[b]) : 0.0f;
        const float reached = wp::clamp(place, -size[1], size[1]);
        return spheres_touch(
            geoms.positions[a], geoms.sizes[a][0], other == CAPSULE ? geoms.positions[b] + along * reached : geoms.positions[b], size[0]
        );
    }
    return other == CAPSULE ? capsules_touch(geoms, a, b, which) : capsule_touches_box(geoms, a, b, which);
}

}
