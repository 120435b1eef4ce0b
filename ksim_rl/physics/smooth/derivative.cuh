// Part 1 of the integration: the matrix and the right side of
//
//     (M - h dF/dv) qacc' = M qacc
//
// (computation chapter, "Numerical integration"), in which h is the timestep and F are those smooth forces that depend
// on velocity: of dampers, and of actuators if the integrator is implicitfast. These act on the degree of freedom that
// they are of, since actuators drive hinges and slides alone, so that dF/dv is diagonal. M qacc is the solver's: with a
// solver that has converged it is the sum of all forces.
//
// The matrix has the entries of M: a row has a degree of freedom's ancestors, from the root on, and then itself.
#pragma once
#include "ksim_rl/physics/smooth/actuators.cuh"
#include "ksim_rl/physics/smooth/needs.cuh"

namespace integration {

using namespace smooth;
using namespace needs;

struct Arguments : ActuatorArguments, NeedsArguments {
    wp::array_t<int> M_rowadr;
    wp::array_t<int> M_rownnz;
    wp::array_t<float> act_dot;
    wp::array_t<int> dof_jntid;
    wp::array_t<bool> jnt_actfrclimited;
    wp::array_t<float> qfrc_actuator;
    wp::array_t<wp::vec2> jnt_actfrcrange;
    wp::array_t<int> first_driver;
    wp::array_t<int> drivers;
    wp::array_t<bool> actuator_forcelimited;
    wp::array_t<float> actuator_force;
    wp::array_t<wp::vec2> actuator_forcerange;
    wp::array_t<int> actuator_biastype;
    wp::array_t<wp::vec_t<10, float>> actuator_biasprm;
    wp::array_t<wp::vec_t<10, float>> actuator_gainprm;
    wp::array_t<float> M;
    wp::array_t<float> qvel;
    wp::array_t<float> efc_Ma;
    wp::array_t<int> eliminated;
    wp::array_t<int> first_change;
    wp::array_t<int> changes;
    wp::array_t<int> leaves;
    wp::array_t<int> M_colind;
    wp::array_t<float> qacc;
    wp::array_t<int> body_freeadr;
    wp::array_t<int> body_dofadr;
    wp::array_t<wp::vec_t<10, float>> crb;
    wp::array_t<float> qpos;
    wp::array_t<int> jnt_qposadr;
    wp::array_t<int> body_jntadr;
    wp::array_t<wp::vec3> subtree_com;
    wp::array_t<float> qacc_warmstart;
    wp::array_t<int> jnt_type;
    wp::array_t<int> jnt_dofadr;
    wp::array_t<float> time;
};

// What the lanes of a world share.
struct SharedMemory {
    float* system;
    float* right;  // M qacc, then D L qacc', and the new velocities
    float* qacc;   // qacc'

    CUDA_CALLABLE explicit SharedMemory(float* begin)
        : system(begin)
        , right(system + NUM_ENTRIES)
        , qacc(right + NUM_DOFS)
    {
    }
};

CUDA_CALLABLE inline int row_start(const Arguments& a, int dof)
{
    return look_up(a.M_rowadr, dof);
}

CUDA_CALLABLE inline int num_ancestors(const Arguments& a, int dof)
{
    return look_up(a.M_rownnz, dof) - 1;
}

CUDA_CALLABLE inline bool is_clamped(float force, const wp::vec2& range)
{
    return force <= range[0] || force >= range[1];
}

CUDA_CALLABLE inline float present_input(const World& world, const Arguments& a, int actuator)
{
    const int address = activation_of(a, actuator);
    return input_of(world, a, actuator, address < 0 ? 0.0f : world.row_of(a.act_dot)[address]);
}

// What velocity adds to the force of the actuators on a degree of freedom.
CUDA_CALLABLE inline float drive_rate(const World& world, const Arguments& a, int dof)
{
    const int joint = look_up(a.dof_jntid, dof);
    float sum = 0.0f;
    if (a.jnt_actfrclimited.data[joint]
        && is_clamped(world.row_of(a.qfrc_actuator)[dof], world.model_row(a.jnt_actfrcrange)[joint]))
        return sum;
#pragma unroll 1
    for (int i = look_up(a.first_driver, dof); i < look_up(a.first_driver, dof + 1); ++i) {
        const int actuator = look_up(a.drivers, i);
        if (is_switched_off(a, actuator))
            continue;
        if (a.actuator_forcelimited.data[actuator]
            && is_clamped(world.row_of(a.actuator_force)[actuator], world.model_row(a.actuator_forcerange)[actuator]))
            continue;
        float rate = 0.0f;
        if (look_up(a.actuator_biastype, actuator) == AFFINE_BIAS)
            rate = world.model_row(a.actuator_biasprm)[actuator][2];
        if (look_up(a.actuator_gaintype, actuator) == AFFINE_GAIN)
            rate += world.model_row(a.actuator_gainprm)[actuator][2] * present_input(world, a, actuator);
        const float gear = world.model_row(a.actuator_gear)[actuator][0];
        sum += gear * (gear * rate);  // a rate of 0 is none, however large the gear is
    }
    return sum;
}

CUDA_CALLABLE inline void fill_system(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float timestep = world.of_world(a.timestep);
#pragma unroll 4
    for (int entry = world.lane; entry < NUM_ENTRIES; entry += LANES)
        shared.system[entry] = world.row_of(a.M)[entry];
    sync_warp();
    world.each(NUM_DOFS, [&](int dof) {
        float rate = 0.0f;
        if (DAMPERS) {
            const Damping damping = damping_of(world, a, look_up(a.dof_jntid, dof), dof);
            const wp::vec2 more(2.0f * damping.more[0], 3.0f * damping.more[1]);
            rate = rate_at(damping.linear, more, wp::abs(world.row_of(a.qvel)[dof]));
        }
        if (IMPLICIT_FAST)
            rate -= drive_rate(world, a, dof);
        shared.system[row_start(a, dof) + num_ancestors(a, dof)] += timestep * rate;
        shared.right[dof] = world.row_of(a.efc_Ma)[dof];
    });
    sync_warp();
}

}
