// The overflow bits of each world and the most that it needed in this period; the first world has those of the pool.

if (lane == 0) {
    auto keep = [](int& most, int needed) { most = wp::max(most, needed); };
    problem.sticky.data[world] |= problem.overflow.data[world];
    keep(problem.most_nefc.data[world], problem.nefc.data[world]);
    if (world == 0) {
        keep(problem.most_pool.data[0], *problem.nacon.data);
        keep(problem.most_pool.data[1], *problem.ncollision.data);
    }
}
