// Part 2: the contacts of this world, in the order of MuJoCo's C engine: by the pair of bodies, then by that of geoms,
// of which each contact has that of the lower type first (engine_collision_driver.c; explicit pairs of geoms, which it
// puts before the others of their bodies, stand among them here).
//
// One thread writes the contacts of a pair one after another, so that their places in the pool are in its order. Only
// contacts of signed distance fields are each written by another thread: these are ordered by where they are.

const int appended = problem.appended.data[world], contacts = wp::min(appended, ROOM);
const int* const found = row_of(problem.found);
unsigned long long* const keys = (unsigned long long*)row_of(problem.keys);
int* const ids = row_of(problem.ids);

each(contacts, [&](int item) {
    const auto& geoms = problem.contact_geom.data[found[item]];
    const int body = problem.geom_bodyid.data[geoms[0]], other = problem.geom_bodyid.data[geoms[1]];
    auto pair_of = [](int a, int b) { return (unsigned)a << 16 | (unsigned)b; };
    const unsigned bodies = pair_of(wp::min(body, other), wp::max(body, other));
    keys[item] = (unsigned long long)bodies << 32 | pair_of(geoms[0], geoms[1]);
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
