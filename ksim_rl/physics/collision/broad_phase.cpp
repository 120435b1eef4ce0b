// Part 1, the broad phase: which pairs of geoms may touch. The tests are those of engine_collision_driver.c: of a plane
// and a bounding sphere, of two spheres, then of two boxes along the axes of both (Gottschalk et al., OBBTree, 1996).
//
// The lanes of a world share its pairs, and take places in the pool for all that pass together: one lane each time, where
// all threads of all worlds would wait for the same counter.

using vec3 = wp::vec3;

const auto* const pairs = problem.pairs.data;  // the lower type first, and how many contacts they may have
const auto* const pair_ids = problem.nxn_pairid_filtered.data;
const int num_pairs = problem.pairs.shape[0];
const wp::vec3* const positions = row_of(problem.geom_xpos);
const wp::mat33* const turns = row_of(problem.geom_xmat);
const wp::vec3* const boxes = model_row(problem.geom_boxes);  // centre and half sizes of each geom
const float* const bounds = model_row(problem.geom_rbound);

auto axis = [](const wp::mat33& turn, int i) { return wp::vec3(turn.data[0][i], turn.data[1][i], turn.data[2][i]); };
auto reach = [](const wp::vec3& size, float x, float y, float z) {
    return wp::abs(size[0] * x) + wp::abs(size[1] * y) + wp::abs(size[2] * z);
};
auto boxes_are_apart = [&](int a, int b, float margin) {
    const wp::mat33 turn = turns[a], other = turns[b];
    const wp::vec3 size = boxes[2 * a + 1], size_b = boxes[2 * b + 1];
    const wp::vec3 between =
        wp::mul(other, boxes[2 * b]) + positions[b] - wp::mul(turn, boxes[2 * a]) - positions[a];
    float along[3][3];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            along[i][k] = wp::dot(axis(turn, i), axis(other, k));
    for (int i = 0; i < 3; ++i) {
        const float far = size[i] + reach(size_b, along[i][0], along[i][1], along[i][2]);
        const float far_b = size_b[i] + reach(size, along[0][i], along[1][i], along[2][i]);
        if (far + margin < wp::abs(wp::dot(between, axis(turn, i)))
            || far_b + margin < wp::abs(wp::dot(between, axis(other, i))))
            return true;
    }
    return false;
};
auto margin_of = [&](int a, int b, int pair) {
    if (!HAS_MARGINS)
        return 0.0f;
    return pair >= 0 ? model_row(problem.pair_margin)[pair] + model_row(problem.pair_gap)[pair]
                     : model_row(problem.geom_margin)[a] + model_row(problem.geom_gap)[a]
                           + model_row(problem.geom_margin)[b] + model_row(problem.geom_gap)[b];
};
auto are_near = [&](int item) {
    const int a = pairs[item][0], b = pairs[item][1];
    const float margin = margin_of(a, b, HAS_MARGINS ? pair_ids[item][0] : -1), bound = bounds[a], bound_b = bounds[b];
    if (MEASURES && pair_ids[item][1] >= 0)
        return true;  // a sensor reads how far they are apart
    const wp::vec3 between = positions[b] - positions[a];
    if (bound == 0.0f)
        return wp::dot(between, axis(turns[a], 2)) <= bound_b + margin;
    if (bound_b == 0.0f)
        return -wp::dot(between, axis(turns[b], 2)) <= bound + margin;
    const float most = bound + bound_b + margin;
    return wp::dot(between, between) <= most * most;
};
auto may_touch = [&](int item) {
    const int a = pairs[item][0], b = pairs[item][1];
    if (bounds[a] == 0.0f || bounds[b] == 0.0f || (MEASURES && pair_ids[item][1] >= 0))
        return true;
    return !boxes_are_apart(a, b, margin_of(a, b, HAS_MARGINS ? pair_ids[item][0] : -1));
};
