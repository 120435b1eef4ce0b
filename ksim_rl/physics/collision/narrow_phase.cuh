// The narrow phase: the contacts of pairs that are near each other, which are kept in shared memory and then written to
// the pool. What a contact has of its two geoms is in "Contact parameters" of
// https://mujoco.readthedocs.io/en/stable/modeling.html#contact-parameters.
#pragma once
#include "ksim_rl/physics/collision/shapes.cuh"

namespace collisions {

constexpr float LEAST_FRICTION = 1e-5f;
constexpr int ROOM = 2 * LANES;  // contacts in shared memory

struct Found {
    Touch touch;
    int pair, which;
};

// A frame whose first tangent is as near as can be to one that is given, or to an axis of the world.
CUDA_CALLABLE inline wp::mat33 frame_of(const vec3& normal, const vec3& wanted)
{
    vec3 tangent = wanted - normal * wp::dot(wanted, normal);
    if (wp::length(tangent) <= 1e-6f) {
        tangent = wp::abs(normal[1]) < 0.5f ? vec3(0.0f, 1.0f, 0.0f) : vec3(0.0f, 0.0f, 1.0f);
        tangent = tangent - normal * wp::dot(tangent, normal);
    }
    tangent = wp::normalize(tangent);
    const vec3 last = wp::cross(normal, tangent);
    return wp::mat33(
        normal[0], normal[1], normal[2], tangent[0], tangent[1], tangent[2], last[0], last[1], last[2]
    );
}

// The tangent that C gives a capsule on a plane: its own direction, and where it stands upright the world's first axis.
CUDA_CALLABLE inline vec3 direction_of(const Geoms& geoms, int capsule, const vec3& normal)
{
    const vec3 along = axis(geoms.turns[capsule], 2);
    return wp::length(wp::cross(along, normal)) > 1e-6f ? along : vec3(1.0f, 0.0f, 0.0f);
}

// Numbers of a contact that follow from both geoms, or from the law of their pair.
struct Law {
    int dim = 0;
    float margin = 0.0f, adhesion = 0.0f;
};

CUDA_CALLABLE inline Law write_law_of_pair(const Geoms& geoms, int pair, int place)
{
    const Arguments& a = geoms.a;
    const World& world = geoms.world;
    Law law;
    if (HAS_MARGINS)
        law.margin = world.model_row(a.pair_margin)[pair];
    auto& friction = a.contact_friction.data[place];
    law.dim = a.pair_dim.data[pair];
    law.adhesion = world.model_row(a.pair_adhesion)[pair];
    a.contact_solref.data[place] = world.model_row(a.pair_solref)[pair];
    a.contact_solreffriction.data[place] = world.model_row(a.pair_solreffriction)[pair];
    a.contact_solimp.data[place] = world.model_row(a.pair_solimp)[pair];
    for (int i = 0; i < 5; ++i)
        friction[i] = wp::max(LEAST_FRICTION, world.model_row(a.pair_friction)[pair][i]);
    return law;
}

// The first geom's share of a mean of laws, by the weights of both.
CUDA_CALLABLE inline float share_of(float weight, float other)
{
    constexpr float TINY = 1e-15f;
    if (weight >= TINY && other >= TINY)
        return weight / (weight + other);
    return weight >= TINY ? 1.0f : other >= TINY ? 0.0f : 0.5f;
}

CUDA_CALLABLE inline Law write_law_of_geoms(const Geoms& geoms, int one, int other, int place)
{
    const Arguments& a = geoms.a;
    const World& world = geoms.world;
    Law found;
    if (HAS_MARGINS)
        found.margin = world.model_row(a.geom_margin)[one] + world.model_row(a.geom_margin)[other];
    auto& friction = a.contact_friction.data[place];
    const int* const priority = a.geom_priority.data;
    const int* const dims = a.geom_condim.data;
    const auto &own = world.model_row(a.geom_friction)[one], &own_b = world.model_row(a.geom_friction)[other];
    const auto &law = world.model_row(a.geom_solref)[one], &law_b = world.model_row(a.geom_solref)[other];
    const auto &curve = world.model_row(a.geom_solimp)[one], &curve_b = world.model_row(a.geom_solimp)[other];
    float mix = share_of(world.model_row(a.geom_solmix)[one], world.model_row(a.geom_solmix)[other]);
    // A geom of lower priority has no part.
    const bool first = priority[one] >= priority[other], second = priority[other] >= priority[one];
    if (!first || !second)
        mix = first ? 1.0f : 0.0f;
    found.dim = wp::max(first ? dims[one] : 0, second ? dims[other] : 0);
    const auto* const adhesions = world.model_row(a.geom_adhesion);
    found.adhesion = (first ? adhesions[one] : 0.0f) + (second ? adhesions[other] : 0.0f);
    for (int i = 0; i < 5; ++i) {
        const int kind = (i > 1) + (i > 2);  // sliding twice, spinning, rolling twice
        friction[i] = wp::max(LEAST_FRICTION, wp::max(first ? own[kind] : 0.0f, second ? own_b[kind] : 0.0f));
        a.contact_solimp.data[place][i] = mix * curve[i] + (1.0f - mix) * curve_b[i];
    }
    for (int i = 0; i < 2; ++i) {
        const bool mixes = (law[0] > 0.0f && law_b[0] > 0.0f) || !first || !second;
        a.contact_solref.data[place][i] = mixes ? mix * law[i] + (1.0f - mix) * law_b[i] : wp::min(law[i], law_b[i]);
        a.contact_solreffriction.data[place][i] = 0.0f;
    }
    return found;
}

// Writes a contact to its place in the pool.
CUDA_CALLABLE inline void write_contact(const Geoms& geoms, const Found& found, int place, bool is_listed)
{
    const Arguments& a = geoms.a;
    const int one = geoms.pairs[found.pair][0], other = geoms.pairs[found.pair][1];
    const int pair = HAS_PAIRS ? geoms.pair_ids[found.pair][0] : -1;
    const bool follows = a.geom_type.data[one] == PLANE && a.geom_type.data[other] == CAPSULE;
    const Law law = pair >= 0 ? write_law_of_pair(geoms, pair, place) : write_law_of_geoms(geoms, one, other, place);
    const Touch& touch = found.touch;
    const vec3 wanted = follows ? direction_of(geoms, other, touch.normal) : vec3();
    a.contact_dist.data[place] = touch.distance;
    a.contact_pos.data[place] = touch.position;
    a.contact_frame.data[place] = frame_of(touch.normal, wanted);
    a.contact_includemargin.data[place] = law.margin;
    a.contact_dim.data[place] = law.adhesion != 0.0f && touch.distance >= law.margin ? 1 : law.dim;
    a.contact_geom.data[place] = wp::vec2i(one, other);
    a.contact_worldid.data[place] = geoms.world.world;
    a.contact_type.data[place] = HAS_ROWS;
    a.contact_geomcollisionid.data[place] = found.which;
    a.contact_adhesion.data[place] = law.adhesion;
    // The kernel of the rows writes the addresses of contacts that are listed.
    const int most = is_listed ? 0 : a.contact_efc_address.shape[1];
    for (int row = 0; row < most; ++row)
        a.contact_efc_address.data[place * most + row] = -1;
}

// The contacts of a world on their way to the pool.
struct Contacts {
    Found* found;  // in shared memory
    int count = 0;
    int listed = 0;  // those that were written

    // Writes all that are in shared memory.
    CUDA_CALLABLE void flush(const Geoms& geoms)
    {
        const Arguments& a = geoms.a;
        const World& world = geoms.world;
        sync();
        if (count > 0) {
            const int first = take(world.lane, a.nacon.data, count);
            const int kept = wp::clamp(a.naconmax - first, 0, count);
            world.each(kept, [&](int item) {
                const bool is_listed = a.lists && listed + item < a.found.shape[1];
                write_contact(geoms, found[item], first + item, is_listed);
                if (is_listed)
                    world.row_of(a.found)[listed + item] = first + item;
            });
            listed += kept;
        }
        count = 0;
        sync();
    }

    // Adds the contact of each lane that has one.
    CUDA_CALLABLE void add(const Geoms& geoms, const Touch& touch, bool touches, int pair, int which)
    {
        const Count lanes = lanes_with(geoms.world.lane, touches);
        if (count + lanes.all > ROOM)
            flush(geoms);
        if (touches)
            found[count + lanes.before] = Found {touch, pair, which};
        count += lanes.all;
    }
};

}
