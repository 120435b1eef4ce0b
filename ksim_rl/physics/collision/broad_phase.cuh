// The broad phase: which pairs of geoms may touch. The tests are as in engine_collision_driver.c: of a plane
// and a bounding sphere, of two spheres, then of two boxes along the axes of both (Gottschalk et al., OBBTree, 1996).
//
// The lanes of a world share its pairs, and take places in the pool for all that pass together.
#pragma once
#include "ksim_rl/physics/collision/arguments.cuh"

namespace collisions {

CUDA_CALLABLE inline vec3 axis(const wp::mat33& turn, int i)
{
    return vec3(turn.data[0][i], turn.data[1][i], turn.data[2][i]);
}

// How far a box reaches along a direction, given in its own axes.
CUDA_CALLABLE inline float reach(const vec3& size, float x, float y, float z)
{
    return wp::abs(size[0] * x) + wp::abs(size[1] * y) + wp::abs(size[2] * z);
}

// The geoms of a world, and the pairs of them that may meet.
struct Geoms {
    const Arguments& a;
    const World& world;
    const wp::vec3i* pairs;     // two geoms, and how many contacts they may have
    const wp::vec2i* pair_ids;  // the pair of its own law, and the sensor that measures it
    const vec3* positions;
    const wp::mat33* turns;
    const vec3* boxes;  // centre and half sizes of each geom
    const float* bounds;
    const vec3* sizes;

    CUDA_CALLABLE Geoms(const Arguments& a, const World& world)
        : a(a)
        , world(world)
        , pairs(a.pairs.data)
        , pair_ids(a.nxn_pairid_filtered.data)
        , positions(world.row_of(a.geom_xpos))
        , turns(world.row_of(a.geom_xmat))
        , boxes(world.model_row(a.geom_boxes))
        , bounds(world.model_row(a.geom_rbound))
        , sizes(world.model_row(a.geom_size))
    {
    }

    CUDA_CALLABLE bool boxes_are_apart(int one, int other, float margin) const
    {
        const wp::mat33 turn = turns[one], turn_b = turns[other];
        const vec3 size = boxes[2 * one + 1], size_b = boxes[2 * other + 1];
        const vec3 between = wp::mul(turn_b, boxes[2 * other]) + positions[other] - wp::mul(turn, boxes[2 * one])
            - positions[one];
        float along[3][3];
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                along[i][k] = wp::dot(axis(turn, i), axis(turn_b, k));
        for (int i = 0; i < 3; ++i) {
            const float far = size[i] + reach(size_b, along[i][0], along[i][1], along[i][2]);
            const float far_b = size_b[i] + reach(size, along[0][i], along[1][i], along[2][i]);
            if (far + margin < wp::abs(wp::dot(between, axis(turn, i)))
                || far_b + margin < wp::abs(wp::dot(between, axis(turn_b, i))))
                return true;
        }
        return false;
    }

    // At which distance a pair makes contacts, with the gap in which these have no rows.
    CUDA_CALLABLE float margin_of(int item) const
    {
        if (!HAS_MARGINS)
            return 0.0f;
        const int pair = pair_ids[item][0], one = pairs[item][0], other = pairs[item][1];
        return pair >= 0 ? world.model_row(a.pair_margin)[pair] + world.model_row(a.pair_gap)[pair]
                         : world.model_row(a.geom_margin)[one] + world.model_row(a.geom_gap)[one]
                               + world.model_row(a.geom_margin)[other] + world.model_row(a.geom_gap)[other];
    }

    // By their bounding spheres.
    CUDA_CALLABLE bool are_near(int item) const
    {
        const int one = pairs[item][0], other = pairs[item][1];
        const float margin = margin_of(item), bound = bounds[one], bound_b = bounds[other];
        if (MEASURES && pair_ids[item][1] >= 0)
            return true;  // a sensor reads how far they are apart
        const vec3 between = positions[other] - positions[one];
        if (bound == 0.0f)
            return wp::dot(between, axis(turns[one], 2)) <= bound_b + margin;
        if (bound_b == 0.0f)
            return -wp::dot(between, axis(turns[other], 2)) <= bound + margin;
        const float most = bound + bound_b + margin;
        return wp::dot(between, between) <= most * most;
    }

    // By their bounding boxes.
    CUDA_CALLABLE bool may_touch(int item) const
    {
        const int one = pairs[item][0], other = pairs[item][1];
        if (bounds[one] == 0.0f || bounds[other] == 0.0f || (MEASURES && pair_ids[item][1] >= 0))
            return true;
        return !boxes_are_apart(one, other, margin_of(item));
    }
};

}
