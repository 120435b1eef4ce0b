// Part 5: what actuators do (mj_transmission, mj_fwdActuation), and the sum of all forces but the constraints'
// (mj_fwdAcceleration). An actuator drives a hinge or a slide, and has a gain, a bias and an activation that are
// affine.
#pragma once
#include "ksim_rl/physics/smooth/passive.cuh"

namespace smooth_dynamics {

CUDA_CALLABLE inline float activation_rate(const World& world, const Arguments& a, int actuator, float ctrl, float act)
{
    const int type = look_up(a.actuator_dyntype, actuator);
    if (type == INTEGRATOR)
        return ctrl;
    if (type == FILTER || type == FILTEREXACT)
        return (ctrl - act) / wp::max(TINY, world.model_row(a.actuator_dynprm)[actuator][0]);
    return 0.0f;
}

CUDA_CALLABLE inline void drive(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float* const qpos = world.row_of(a.qpos);
    const float* const qvel = world.row_of(a.qvel);
    world.each(NUM_ACTUATORS, [&](int actuator) {
        const int joint = a.actuator_trnid.data[actuator][0], dof = look_up(a.jnt_dofadr, joint);
        const float gear = world.model_row(a.actuator_gear)[actuator][0];
        const float length = qpos[look_up(a.jnt_qposadr, joint)] * gear, speed = gear * qvel[dof];
        if (a.is_read) {
            world.row_of(a.actuator_length)[actuator] = length;
            // C does not compute it without actuation.
            world.row_of(a.actuator_velocity)[actuator] = ACTUATORS_ACT ? speed : 0.0f;
            world.row_of(a.moment_rownnz)[actuator] = 1;
            world.row_of(a.moment_rowadr)[actuator] = actuator;
            world.row_of(a.moment_colind)[actuator] = dof;
            world.row_of(a.actuator_moment)[actuator] = gear;
        }
        float rate = 0.0f, found = 0.0f;
        const int address = activation_of(a, actuator);
        if (address >= 0) {
            if (ACTUATORS_ACT)
                rate = activation_rate(world, a, actuator, ctrl_of(world, a, actuator), world.row_of(a.act)[address]);
            world.row_of(a.act_dot)[address] = rate;
        }
        const float input = input_of(world, a, actuator, rate);
        if (ACTUATORS_ACT && !is_switched_off(a, actuator)) {
            auto affine = [&](const auto& factors) {
                return factors[0] + factors[1] * length + factors[2] * speed;
            };
            const auto gain = world.model_row(a.actuator_gainprm)[actuator];
            const auto bias = world.model_row(a.actuator_biasprm)[actuator];
            found = (look_up(a.actuator_gaintype, actuator) == AFFINE_GAIN ? affine(gain) : gain[0]) * input;
            found += look_up(a.actuator_biastype, actuator) == AFFINE_BIAS ? affine(bias) : 0.0f;
        }
        // C keeps what is switched off within a range, too, which need not have 0 in it.
        if (ACTUATORS_ACT && a.actuator_forcelimited.data[actuator]) {
            const wp::vec2 range = world.model_row(a.actuator_forcerange)[actuator];
            found = wp::clamp(found, range[0], range[1]);
        }
        world.row_of(a.actuator_force)[actuator] = shared.actuator_forces[actuator] = found;
    });
}

// Forces that the user applies to bodies are rare: whether this lane sees one, and then whether any does.
CUDA_CALLABLE inline bool is_pushed(const World& world, const Arguments& a)
{
    bool sees_push = false;
#pragma unroll 8
    for (int place = world.lane; place < 6 * NUM_BODIES; place += LANES)
        sees_push |= !(((const float*)world.row_of(a.xfrc_applied))[place] == 0.0f);
    sync_warp();
#if defined(__CUDA_ARCH__)
    return __ballot_sync(own_lanes(), sees_push) != 0;
#else
    return sees_push;
#endif
}

CUDA_CALLABLE inline void sum_smooth_forces(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float* const mass = world.model_row(a.body_mass);
    const bool pushed = is_pushed(world, a);
    world.each(NUM_DOFS, [&](int dof) {
        const int joint = look_up(a.dof_jntid, dof), body = look_up(a.dof_bodyid, dof);
        const float bias = wp::dot(shared.motion(dof), shared.force(body));
        float driven = 0.0f;
#pragma unroll 1
        for (int i = look_up(a.first_driver, dof); i < look_up(a.first_driver, dof + 1); ++i) {
            const int actuator = look_up(a.drivers, i);
            driven += world.model_row(a.actuator_gear)[actuator][0] * shared.actuator_forces[actuator];
        }
        if (LIFTS) {
            // Weights that are compensated (mj_gravcomp), as passive forces or by actuators.
            const vec3 spin = rotation_of(shared.motion(dof)), origin = shared.com(look_up(a.body_rootid, body));
            float lifted = 0.0f;
#pragma unroll 1
            for (int of = body; of < body + look_up(a.body_subtreenum, body); ++of) {
                const vec3 moved
                    = translation_of(shared.motion(dof)) + wp::cross(spin, world.row_of(a.xipos)[of] - origin);
                lifted -= wp::dot(moved, world.of_world(a.gravity)) * mass[of] * world.model_row(a.body_gravcomp)[of];
            }
            world.row_of(a.qfrc_gravcomp)[dof] = lifted;
            const bool is_driven = a.jnt_actgravcomp.data[joint];
            driven += is_driven && ACTUATORS_ACT ? lifted : 0.0f;
            world.row_of(a.qfrc_passive)[dof] = shared.passive[dof] += is_driven ? 0.0f : lifted;
        }
        if (ACTUATORS_ACT && a.jnt_actfrclimited.data[joint]) {
            const wp::vec2 range = world.model_row(a.jnt_actfrcrange)[joint];
            driven = wp::clamp(driven, range[0], range[1]);
        }
        float sum = shared.passive[dof] - bias + driven + world.row_of(a.qfrc_applied)[dof];
        if (pushed) {
            const vec3 spin = rotation_of(shared.motion(dof)), origin = shared.com(look_up(a.body_rootid, body));
#pragma unroll 1
            for (int of = body; of < body + look_up(a.body_subtreenum, body); ++of) {
                const spatial push = world.row_of(a.xfrc_applied)[of];  // its translation comes first
                const vec3 arm = world.row_of(a.xipos)[of] - origin;
                sum += wp::dot(translation_of(shared.motion(dof)) + wp::cross(spin, arm), rotation_of(push));
                sum += wp::dot(spin, translation_of(push));
            }
        }
        if (a.is_read)
            world.row_of(a.qfrc_bias)[dof] = bias;
        world.row_of(a.qfrc_actuator)[dof] = driven;
        world.row_of(a.qfrc_smooth)[dof] = sum;
    });
}

}
