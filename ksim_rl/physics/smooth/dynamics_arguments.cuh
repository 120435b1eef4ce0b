// What smooth dynamics take: arrays of a model and its worlds, and what is asked for.
#pragma once
#include "ksim_rl/physics/smooth/actuators.cuh"
#include "ksim_rl/physics/smooth/spatial.cuh"

namespace smooth_dynamics {

using namespace smooth;

struct Arguments : ActuatorArguments {
    bool masked;
    wp::array_t<bool> mask;
    wp::array_t<float> qpos;
    wp::array_t<float> qpos0;
    wp::array_t<int> body_branch_start;
    wp::array_t<int> jnt_type;
    wp::array_t<int> jnt_qposadr;
    wp::array_t<wp::vec3> jnt_axis;
    wp::array_t<int> body_branches;
    wp::array_t<int> body_jntadr;
    wp::array_t<int> body_jntnum;
    wp::array_t<wp::vec3> body_pos;
    wp::array_t<wp::quat> body_quat;
    wp::array_t<int> body_mocapid;
    wp::array_t<wp::vec3> mocap_pos;
    wp::array_t<wp::quat> mocap_quat;
    wp::array_t<wp::vec3> jnt_pos;
    wp::array_t<int> moving_geoms;
    bool places_geoms;
    wp::array_t<wp::vec3> geom_xpos;
    wp::array_t<int> geom_bodyid;
    wp::array_t<wp::vec3> geom_pos;
    wp::array_t<wp::mat33> geom_xmat;
    wp::array_t<wp::quat> geom_quat;
    bool empties_pool;
    wp::array_t<int> nacon;
    bool goes_on;
    wp::array_t<wp::vec3> body_ipos;
    wp::array_t<wp::quat> body_iquat;
    wp::array_t<wp::vec3> xipos;
    bool is_read;
    wp::array_t<wp::vec3> xpos;
    wp::array_t<wp::quat> xquat;
    wp::array_t<wp::vec3> xanchor;
    wp::array_t<wp::vec3> xaxis;
    wp::array_t<wp::mat33> xmat;
    wp::array_t<wp::mat33> ximat;
    wp::array_t<wp::vec3> site_xpos;
    wp::array_t<int> site_bodyid;
    wp::array_t<wp::vec3> site_pos;
    wp::array_t<wp::mat33> site_xmat;
    wp::array_t<wp::quat> site_quat;
    wp::array_t<float> body_mass;
    wp::array_t<float> body_subtreemass;
    wp::array_t<wp::vec3> subtree_com;
    wp::array_t<int> jnt_bodyid;
    wp::array_t<int> jnt_dofadr;
    wp::array_t<int> body_rootid;
    wp::array_t<wp::vec_t<6, float>> cdof;
    wp::array_t<wp::vec3> body_inertia;
    wp::array_t<wp::vec_t<10, float>> cinert;
    wp::array_t<float> qvel;
    wp::array_t<wp::vec3> gravity;
    wp::array_t<int> body_dofadr;
    wp::array_t<wp::vec_t<6, float>> cdof_dot;
    wp::array_t<wp::vec_t<6, float>> cvel;
    bool forces_too;
    bool sums_momenta;
    wp::array_t<wp::vec3> subtree_linvel;
    wp::array_t<wp::vec3> subtree_angmom;
    wp::array_t<wp::vec_t<6, float>> cacc;
    wp::array_t<wp::vec_t<6, float>> cfrc_int;
    wp::array_t<wp::vec_t<10, float>> crb;
    wp::array_t<int> dof_bodyid;
    wp::array_t<int> M_hinit_i;
    wp::array_t<int> M_colind;
    wp::array_t<float> M;
    wp::array_t<float> dof_armature;
    wp::array_t<int> dof_jntid;
    wp::array_t<float> actuator_armature;
    wp::array_t<int> M_rowadr;
    wp::array_t<int> M_rownnz;
    wp::array_t<float> jnt_stiffness;
    wp::array_t<wp::vec2> jnt_stiffnesspoly;
    wp::array_t<float> qpos_spring;
    wp::array_t<float> qfrc_spring;
    wp::array_t<float> qfrc_damper;
    wp::array_t<float> qfrc_passive;
    wp::array_t<float> actuator_length;
    wp::array_t<float> actuator_velocity;
    wp::array_t<int> moment_rownnz;
    wp::array_t<int> moment_rowadr;
    wp::array_t<int> moment_colind;
    wp::array_t<float> actuator_moment;
    wp::array_t<float> act_dot;
    wp::array_t<wp::vec_t<10, float>> actuator_gainprm;
    wp::array_t<wp::vec_t<10, float>> actuator_biasprm;
    wp::array_t<int> actuator_biastype;
    wp::array_t<bool> actuator_forcelimited;
    wp::array_t<wp::vec2> actuator_forcerange;
    wp::array_t<float> actuator_force;
    wp::array_t<wp::vec_t<6, float>> xfrc_applied;
    wp::array_t<int> first_driver;
    wp::array_t<int> drivers;
    wp::array_t<int> body_subtreenum;
    wp::array_t<float> body_gravcomp;
    wp::array_t<float> qfrc_gravcomp;
    wp::array_t<int> jnt_actgravcomp;
    wp::array_t<bool> jnt_actfrclimited;
    wp::array_t<wp::vec2> jnt_actfrcrange;
    wp::array_t<float> qfrc_applied;
    wp::array_t<float> qfrc_bias;
    wp::array_t<float> qfrc_actuator;
    wp::array_t<float> qfrc_smooth;
};

}
