// What the collision pass takes: arrays of a model and its worlds, and lists of contacts.
#pragma once
#include "ksim_rl/device/lanes.cuh"

namespace collisions {

namespace given {
// Types of geoms.
constexpr int PLANE = 0;
constexpr int SPHERE = 2;
constexpr int CAPSULE = 3;
constexpr int CYLINDER = 5;
constexpr int BOX = 6;
// Whether margins or gaps are anywhere, pairs of geoms have laws of their own, a sensor measures how far geoms are apart,
// and MuJoCo Warp's narrow phase has pairs left.
constexpr int HAS_MARGINS = 1;
constexpr int HAS_PAIRS = 1;
constexpr int MEASURES = 1;
constexpr int OTHERS = 1;
// The type of a contact that may have rows.
constexpr int HAS_ROWS = 1;
}

using namespace given;
using namespace lanes;
using vec3 = wp::vec3;

struct Arguments {
    wp::array_t<wp::vec3i> pairs;  // the lower type first, and how many contacts they may have
    wp::array_t<wp::vec2i> nxn_pairid_filtered;
    wp::array_t<wp::vec3> geom_xpos;
    wp::array_t<wp::mat33> geom_xmat;
    wp::array_t<wp::vec3> geom_boxes;  // centre and half sizes of each geom
    wp::array_t<float> geom_rbound;
    wp::array_t<float> pair_margin;
    wp::array_t<float> pair_gap;
    wp::array_t<float> geom_margin;
    wp::array_t<float> geom_gap;
    wp::array_t<wp::vec3> geom_size;
    wp::array_t<int> geom_type;
    wp::array_t<wp::vec_t<5, float>> contact_friction;
    wp::array_t<int> pair_dim;
    wp::array_t<float> pair_adhesion;
    wp::array_t<wp::vec2> contact_solref;
    wp::array_t<wp::vec2> pair_solref;
    wp::array_t<wp::vec2> contact_solreffriction;
    wp::array_t<wp::vec2> pair_solreffriction;
    wp::array_t<wp::vec_t<5, float>> contact_solimp;
    wp::array_t<wp::vec_t<5, float>> pair_solimp;
    wp::array_t<wp::vec_t<5, float>> pair_friction;
    wp::array_t<int> geom_priority;
    wp::array_t<int> geom_condim;
    wp::array_t<wp::vec3> geom_friction;
    wp::array_t<wp::vec2> geom_solref;
    wp::array_t<wp::vec_t<5, float>> geom_solimp;
    wp::array_t<float> geom_solmix;
    wp::array_t<float> geom_adhesion;
    wp::array_t<float> contact_dist;
    wp::array_t<wp::vec3> contact_pos;
    wp::array_t<wp::mat33> contact_frame;
    wp::array_t<float> contact_includemargin;
    wp::array_t<int> contact_dim;
    wp::array_t<wp::vec2i> contact_geom;
    wp::array_t<int> contact_worldid;
    wp::array_t<int> contact_type;
    wp::array_t<int> contact_geomcollisionid;
    wp::array_t<float> contact_adhesion;
    wp::array_t<int> contact_efc_address;
    wp::array_t<int> nacon;  // how many contacts the pool has
    int naconmax;
    int lists;  // whether contacts are listed as they come
    wp::array_t<int> found;  // their places in the pool
    wp::array_t<int> ncollision;
    wp::array_t<wp::vec2i> collision_pair;
    wp::array_t<wp::vec2i> collision_pairid;
    wp::array_t<int> collision_worldid;
    wp::array_t<int> appended;  // how many contacts of a world are listed
};

}
