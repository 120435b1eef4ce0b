// What the kernel of constraint rows takes: arrays of a model and its worlds, and the lists of contacts.
#pragma once
#include "ksim_rl/physics/rows/contact_order.cuh"

namespace constraint_rows {

namespace given {
// Types of rows, and of joints.
constexpr int EQUALITY = 0;
constexpr int FRICTION_DOF = 1;
constexpr int LIMIT_JOINT = 3;
constexpr int CONTACT_FRICTIONLESS = 5;
constexpr int CONTACT_PYRAMIDAL = 6;
constexpr int CONTACT_ELLIPTIC = 7;
constexpr int BALL = 1;
constexpr int OUT_OF_NONZEROS = 2;  // a bit of overflow
constexpr int NUM_DOFS = 14;
constexpr int NJMAX = 64;           // rows of a world
constexpr int MOST_NONZEROS = 640;  // of these rows
constexpr int EQUALITIES = 1;       // of joints
constexpr int LIMITED_JOINTS = 8;
// Whether a joint may be at both of its limits, there is dry friction, contacts have rows, friction cones are elliptic, and
// references are no faster than two timesteps.
constexpr int BOTH_LIMITS = 1;
constexpr int FRICTIONLOSS = 1;
constexpr int CONTACTS = 1;
constexpr int ELLIPTIC = 1;
constexpr int REFSAFE = 1;
}

using namespace given;
using namespace contact_order;
using vec3 = wp::vec3;
using quat = wp::quat;

struct Arguments : ListArguments {
    wp::array_t<float> timestep;
    wp::array_t<float> qpos;
    wp::array_t<float> qvel;
    wp::array_t<float> efc_J;
    wp::array_t<int> efc_J_colind;
    wp::array_t<int> efc_id;
    wp::array_t<int> efc_type;
    wp::array_t<float> efc_pos;
    wp::array_t<float> efc_margin;
    wp::array_t<float> efc_vel;
    wp::array_t<float> efc_D;
    wp::array_t<float> efc_aref;
    wp::array_t<float> efc_frictionloss;
    wp::array_t<int> eq_jnt_adr;
    wp::array_t<bool> eq_active;
    wp::array_t<int> eq_obj1id;
    wp::array_t<int> eq_obj2id;
    wp::array_t<wp::vec_t<12, float>> eq_data;
    wp::array_t<int> jnt_qposadr;
    wp::array_t<float> qpos0;
    wp::array_t<int> jnt_dofadr;
    wp::array_t<float> dof_invweight0;
    wp::array_t<int> efc_J_rownnz;
    wp::array_t<int> efc_J_rowadr;
    wp::array_t<wp::vec2> eq_solref;
    wp::array_t<wp::vec_t<5, float>> eq_solimp;
    wp::array_t<float> dof_frictionloss;
    wp::array_t<wp::vec2> dof_solref;
    wp::array_t<wp::vec_t<5, float>> dof_solimp;
    wp::array_t<int> limited;
    wp::array_t<int> jnt_type;
    wp::array_t<wp::vec2> jnt_range;
    wp::array_t<float> jnt_margin;
    wp::array_t<wp::vec2> jnt_solref;
    wp::array_t<wp::vec_t<5, float>> jnt_solimp;
    wp::array_t<unsigned long long> dofs_of_geom;
    wp::array_t<wp::mat33> contact_frame;
    wp::array_t<wp::vec_t<6, float>> cdof;
    wp::array_t<wp::vec3> subtree_com;
    wp::array_t<int> body_rootid;
    wp::array_t<int> dof_bodyid;
    wp::array_t<int> contact_efc_address;
    wp::array_t<wp::vec2> body_invweight0;
    wp::array_t<float> impratio_invsqrt;
    wp::array_t<int> ne;
    wp::array_t<int> nf;
    wp::array_t<int> nl;
    wp::array_t<int> nefc;
    wp::array_t<int> overflow;
};

}
