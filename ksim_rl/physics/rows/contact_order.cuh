// The contacts of a world, in the order of MuJoCo's C engine: by the pair of bodies, then contacts of explicit pairs,
// in their order, before the others by their geoms, of which each contact has the one of the lower type first
// (engine_collision_driver.c).
//
// What writes the contacts of a pair numbers them in its order (geomcollisionid), as lanes of a warp that find them side
// by side take places in the pool as they come. Only contacts of signed distance fields have no such numbers: these are
// ordered by where they are.
#pragma once
#include "ksim_rl/device/lanes.cuh"

namespace contact_order {

namespace given {
constexpr int ROOM = 64;            // contacts of a world that are listed
constexpr int SDF = 0;              // whether there are signed distance fields
constexpr int PAIRS = 1;            // of geoms, with laws of their own
constexpr int REPEATED_PAIRS = 0;   // whether some of these are of the same geoms
}

using namespace given;
using namespace lanes;
using mask64 = unsigned long long;

constexpr unsigned NOT_EXPLICIT = 1u << 31;
constexpr int GEOM_BITS = 15;
constexpr float LEAST_FRICTION = 1e-5f;

// What kernels take that list the contacts of a world in their order.
struct ListArguments {
    wp::array_t<wp::vec_t<5, float>> pair_friction;
    wp::array_t<int> contact_dim;
    wp::array_t<float> contact_includemargin;
    wp::array_t<int> pair_dim;
    wp::array_t<float> contact_adhesion;
    wp::array_t<float> pair_margin;
    wp::array_t<wp::vec_t<5, float>> contact_friction;
    wp::array_t<wp::vec2> contact_solref;
    wp::array_t<wp::vec2> pair_solref;
    wp::array_t<wp::vec_t<5, float>> contact_solimp;
    wp::array_t<wp::vec_t<5, float>> pair_solimp;
    wp::array_t<wp::vec2> pair_solreffriction;
    wp::array_t<wp::vec2> contact_solreffriction;
    wp::array_t<wp::vec2i> contact_geom;
    wp::array_t<int> pair_geom1;
    wp::array_t<int> pair_geom2;
    wp::array_t<int> appended;
    wp::array_t<int> found;
    wp::array_t<unsigned long long> keys;
    wp::array_t<int> ids;
    wp::array_t<int> geom_bodyid;
    wp::array_t<float> contact_dist;
    wp::array_t<wp::vec3> contact_pos;
    wp::array_t<int> contact_geomcollisionid;
    wp::array_t<int> count;
};

template <class One, class Other>
CUDA_CALLABLE inline bool equals(const One& one, const Other& other, int size)
{
    bool same = true;
    for (int i = 0; i < size; ++i)
        same &= one[i] == other[i];
    return same;
}

// Of explicit pairs of the same geoms, a contact has the law of its own one.
CUDA_CALLABLE inline bool has_law_of(const World& world, const ListArguments& a, int contact, int pair)
{
    const auto& friction = world.model_row(a.pair_friction)[pair];
    // Adhesion makes it one of dimension 1 where it is in a gap, and contacts without rows have a margin of their own.
    const int dim = a.contact_dim.data[contact];
    const float margin = a.contact_includemargin.data[contact];
    bool same = dim == a.pair_dim.data[pair] || (dim == 1 && a.contact_adhesion.data[contact] != 0.0f);
    same &= margin < 0.0f || margin == world.model_row(a.pair_margin)[pair];
    for (int i = 0; i < 5; ++i)
        same &= a.contact_friction.data[contact][i] == wp::max(LEAST_FRICTION, friction[i]);
    same &= equals(a.contact_solref.data[contact], world.model_row(a.pair_solref)[pair], 2);
    same &= equals(a.contact_solimp.data[contact], world.model_row(a.pair_solimp)[pair], 5);
    const auto& across = world.model_row(a.pair_solreffriction)[pair];
    return same && equals(a.contact_solreffriction.data[contact], across, 2);
}

// The pair of its own law that a contact is of, or -1.
CUDA_CALLABLE inline int explicit_pair_of(const World& world, const ListArguments& a, int contact)
{
    const auto& geoms = a.contact_geom.data[contact];
#pragma unroll 1
    for (int pair = 0; pair < PAIRS; ++pair) {
        const int one = a.pair_geom1.data[pair], two = a.pair_geom2.data[pair];
        const bool is_of = (one == geoms[0] && two == geoms[1]) || (two == geoms[0] && one == geoms[1]);
        if (is_of && (!REPEATED_PAIRS || has_law_of(world, a, contact, pair)))
            return pair;
    }
    return -1;
}

// Whether a contact comes before another one; keys that are equal leave it open.
CUDA_CALLABLE inline bool precedes(const ListArguments& a, const mask64* keys, const int* found, int item, int other)
{
    if (keys[item] != keys[other])
        return keys[item] < keys[other];
    const int one = found[item], two = found[other];
    if (SDF) {
        if (a.contact_dist.data[one] != a.contact_dist.data[two])
            return a.contact_dist.data[one] < a.contact_dist.data[two];
        for (int i = 0; i < 3; ++i)
            if (a.contact_pos.data[one][i] != a.contact_pos.data[two][i])
                return a.contact_pos.data[one][i] < a.contact_pos.data[two][i];
    }
    if (a.contact_geomcollisionid.data[one] != a.contact_geomcollisionid.data[two])
        return a.contact_geomcollisionid.data[one] < a.contact_geomcollisionid.data[two];
    return one < two;
}

// Lists the contacts of a world in that order, and returns how many there are.
CUDA_CALLABLE inline int order_contacts(const World& world, const ListArguments& a)
{
    const int contacts = wp::min(a.appended.data[world.world], ROOM);
    const int* const found = world.row_of(a.found);
    mask64* const keys = (mask64*)world.row_of(a.keys);
    int* const ids = world.row_of(a.ids);
    world.each(contacts, [&](int item) {
        const auto& geoms = a.contact_geom.data[found[item]];
        const int body = a.geom_bodyid.data[geoms[0]], other = a.geom_bodyid.data[geoms[1]];
        const unsigned bodies = (unsigned)wp::min(body, other) << 16 | (unsigned)wp::max(body, other);
        const int pair = PAIRS > 0 ? explicit_pair_of(world, a, found[item]) : -1;
        const unsigned of_geoms = (unsigned)geoms[0] << GEOM_BITS | (unsigned)geoms[1];
        keys[item] = (unsigned long long)bodies << 32 | (pair >= 0 ? (unsigned)pair : NOT_EXPLICIT | of_geoms);
    });
    sync();
    world.each(contacts, [&](int item) {
        int place = 0;
        for (int other = 0; other < contacts; ++other)
            place += precedes(a, keys, found, other, item);
        ids[place] = found[item];
    });
    sync();
    if (world.lane == 0)
        a.count.data[world.world] = contacts;
    return contacts;
}

}
