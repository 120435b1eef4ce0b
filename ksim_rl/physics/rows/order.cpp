// Part 2: the contacts of this world, in the order of MuJoCo's C engine: by the pair of bodies, then those of explicit
// pairs, in their order, before the others by their geoms, of which each contact has that of the lower type first
// (engine_collision_driver.c).
//
// One thread writes the contacts of a pair one after another, so that their places in the pool are in its order. Only
// contacts of signed distance fields are each written by another thread: these are ordered by where they are.

constexpr unsigned NOT_EXPLICIT = 1u << 31;
constexpr int GEOM_BITS = 15;
constexpr float LEAST_FRICTION = 1e-5f;
auto equals = [](const auto& one, const auto& other, int size) {
    bool same = true;
    for (int i = 0; i < size; ++i)
        same &= one[i] == other[i];
    return same;
};
// Of explicit pairs of the same geoms, a contact has the law of its own one.
auto has_law_of = [&](int contact, int pair) {
    const auto& friction = model_row(problem.pair_friction)[pair];
    // Adhesion makes it one of dimension 1 where it is in a gap, and contacts without rows have a margin of their own.
    const int dim = problem.contact_dim.data[contact];
    const float margin = problem.contact_includemargin.data[contact];
    bool same = dim == problem.pair_dim.data[pair] || (dim == 1 && problem.contact_adhesion.data[contact] != 0.0f);
    same &= margin < 0.0f || margin == model_row(problem.pair_margin)[pair];
    for (int i = 0; i < 5; ++i)
        same &= problem.contact_friction.data[contact][i] == wp::max(LEAST_FRICTION, friction[i]);
    same &= equals(problem.contact_solref.data[contact], model_row(problem.pair_solref)[pair], 2);
    same &= equals(problem.contact_solimp.data[contact], model_row(problem.pair_solimp)[pair], 5);
    const auto& across = model_row(problem.pair_solreffriction)[pair];
    return same && equals(problem.contact_solreffriction.data[contact], across, 2);
};
auto explicit_pair_of = [&](int contact) {
    const auto& geoms = problem.contact_geom.data[contact];
#pragma unroll 1
    for (int pair = 0; pair < PAIRS; ++pair) {
        const int a = problem.pair_geom1.data[pair], b = problem.pair_geom2.data[pair];
        const bool is_of = (a == geoms[0] && b == geoms[1]) || (b == geoms[0] && a == geoms[1]);
        if (is_of && (!REPEATED_PAIRS || has_law_of(contact, pair)))
            return pair;
    }
    return -1;
};

const int appended = problem.appended.data[world], contacts = wp::min(appended, ROOM);
const int* const found = row_of(problem.found);
unsigned long long* const keys = (unsigned long long*)row_of(problem.keys);
int* const ids = row_of(problem.ids);

each(contacts, [&](int item) {
    const auto& geoms = problem.contact_geom.data[found[item]];
    const int body = problem.geom_bodyid.data[geoms[0]], other = problem.geom_bodyid.data[geoms[1]];
    const unsigned bodies = (unsigned)wp::min(body, other) << 16 | (unsigned)wp::max(body, other);
    const int pair = PAIRS > 0 ? explicit_pair_of(found[item]) : -1;
    const unsigned of_geoms = (unsigned)geoms[0] << GEOM_BITS | (unsigned)geoms[1];
    keys[item] = (unsigned long long)bodies << 32 | (pair >= 0 ? (unsigned)pair : NOT_EXPLICIT | of_geoms);
});
sync();

auto precedes = [&](int item, int other) {
    if (keys[item] != keys[other])
        return keys[item] < keys[other];
    const int a = found[item], b = found[other];
    if (SDF) {
        if (problem.contact_dist.data[a] != problem.contact_dist.data[b])
            return problem.contact_dist.data[a] < problem.contact_dist.data[b];
        for (int i = 0; i < 3; ++i)
            if (problem.contact_pos.data[a][i] != problem.contact_pos.data[b][i])
                return problem.contact_pos.data[a][i] < problem.contact_pos.data[b][i];
    }
    // Pairs that are the same in all have contacts of several threads.
    if (REPEATED_PAIRS && problem.contact_geomcollisionid.data[a] != problem.contact_geomcollisionid.data[b])
        return problem.contact_geomcollisionid.data[a] < problem.contact_geomcollisionid.data[b];
    return a < b;
};
each(contacts, [&](int item) {
    int place = 0;
    for (int other = 0; other < contacts; ++other)
        place += precedes(other, item);
    ids[place] = found[item];
});
sync();
if (lane == 0)
    problem.count.data[world] = contacts;
