// Part 4 of the integration: the state at the end of the substep (mj_advance), and which rows and contacts found no room.
#pragma once
#include "ksim_rl/physics/smooth/free_bodies.cuh"

namespace integration {

CUDA_CALLABLE inline void advance(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float timestep = world.of_world(a.timestep);
    world.each(NUM_DOFS, [&](int dof) {
        world.row_of(a.qvel)[dof] = shared.right[dof] = world.row_of(a.qvel)[dof] + timestep * shared.qacc[dof];
        world.row_of(a.qacc_warmstart)[dof] = world.row_of(a.qacc)[dof];
    });
    if (ACTUATORS_ACT)
        world.each(NUM_ACTUATORS, [&](int actuator) {
            const int address = activation_of(a, actuator);
            if (address < 0 || is_switched_off(a, actuator))
                return;
            const float rate = world.row_of(a.act_dot)[address];
            world.row_of(a.act)[address] = next_activation(world, a, actuator, address, rate);
        });
    sync_warp();
    world.each(NUM_JOINTS, [&](int joint) {
        const int type = look_up(a.jnt_type, joint);
        const float* v = shared.right + look_up(a.jnt_dofadr, joint);
        float* q = world.row_of(a.qpos) + look_up(a.jnt_qposadr, joint);
        if (type == HINGE || type == SLIDE) {
            q[0] += timestep * v[0];
            return;
        }
        if (type == FREE) {
            for (int i = 0; i < 3; ++i)
                q[i] += timestep * v[i];
            q += 3;
            v += 3;
        }
        const vec3 spin(v[0], v[1], v[2]), axis = wp::normalize(spin);
        const float half = 0.5f * timestep * wp::length(spin), sine = wp::sin(half);
        const quat by(wp::cos(half), sine * axis[0], sine * axis[1], sine * axis[2]);
        const quat reached = wp::normalize(product(unit_quat(q), by));
        q[0] = reached.x;
        q[1] = reached.y;
        q[2] = reached.z;
        q[3] = reached.w;
    });
}

// Which rows and contacts found no room, and what a world needed.
CUDA_CALLABLE inline void note_overflow(const World& world, const Arguments& a)
{
    a.overflow.data[world.world] |= lacking(world.world, a);
    keep_needs(world.world, a);
}

}
