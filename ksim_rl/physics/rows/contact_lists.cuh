// The second half of the lists, where no kernel of constraint rows makes it on its way: their order.
#pragma once
#include "ksim_rl/physics/rows/contact_order.cuh"

namespace contact_lists {

using namespace contact_order;

struct Arguments {
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

CUDA_CALLABLE inline void run(int index, int lane, const Arguments& a)
{
    order_contacts(world_of(index, lane), a);
}

}
