// The overflow bits of each world and the most that it needed in this period; the first world has those of the pool.
//
// Bits are set from the counts here too: the integration sets them at the end of a substep, and one that evaluates the
// forces several times on its way has made rows that it does not count.

if (lane == 0) {
    auto keep = [](int& most, int needed) { most = wp::max(most, needed); };
    const int rows = problem.nefc.data[world], contacts = *problem.nacon.data, pairs = *problem.ncollision.data;
    const int lacking = (rows > problem.njmax ? OUT_OF_ROWS : 0) | (pairs > problem.naconmax ? OUT_OF_PAIRS : 0)
        | (contacts > problem.naconmax ? OUT_OF_CONTACTS : 0);
    problem.sticky.data[world] |= problem.overflow.data[world] | lacking;
    keep(problem.most_nefc.data[world], rows);
    if (world == 0) {
        keep(problem.most_pool.data[0], contacts);
        keep(problem.most_pool.data[1], pairs);
    }
}
