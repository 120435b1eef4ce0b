// Part 4: passive forces of springs and dampers (mj_passive).
#pragma once
#include "ksim_rl/physics/smooth/velocities.cuh"

namespace smooth_dynamics {

CUDA_CALLABLE inline void find_passive_forces(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float* const qpos = world.row_of(a.qpos);
    const float* const qvel = world.row_of(a.qvel);
    world.each(NUM_JOINTS, [&](int joint) {
        const int type = look_up(a.jnt_type, joint);
        const int dof = look_up(a.jnt_dofadr, joint), dofs = type == FREE ? 6 : type == BALL ? 3 : 1;
        float spring[6] = {};
        const float stiffness = world.model_row(a.jnt_stiffness)[joint];
        const wp::vec2 more_stiffness = world.model_row(a.jnt_stiffnesspoly)[joint];
        if (SPRINGS && (stiffness != 0.0f || more_stiffness[0] != 0.0f || more_stiffness[1] != 0.0f)) {
            const float* q = qpos + look_up(a.jnt_qposadr, joint);
            const float* rest = world.model_row(a.qpos_spring) + look_up(a.jnt_qposadr, joint);
            auto pull = [&](float* to, const vec3& away) {
                const float rate = rate_at(stiffness, more_stiffness, wp::length(away));
                for (int i = 0; i < 3; ++i)
                    to[i] = -rate * away[i];
            };
            if (type == FREE) {
                pull(spring, vec3(q[0] - rest[0], q[1] - rest[1], q[2] - rest[2]));
                q += 3;
                rest += 3;
            }
            if (type == FREE || type == BALL) {
                const quat back(rest[0], -rest[1], -rest[2], -rest[3]);
                pull(spring + (dofs - 3), rotation_vector(product(back, unit_quat(q))));
            } else
                spring[0] = (rest[0] - q[0]) * rate_at(stiffness, more_stiffness, q[0] - rest[0]);
        }
        for (int i = 0; i < dofs; ++i) {
            const Damping damping = DAMPERS ? damping_of(world, a, joint, dof + i) : Damping();
            const bool damps = damping.linear != 0.0f || damping.more[0] != 0.0f || damping.more[1] != 0.0f;
            const float speed = qvel[dof + i];
            const float damper = damps ? -speed * rate_at(damping.linear, damping.more, wp::abs(speed)) : 0.0f;
            shared.passive[dof + i] = spring[i] + damper;
            if (!a.is_read)
                continue;
            world.row_of(a.qfrc_spring)[dof + i] = spring[i];
            world.row_of(a.qfrc_damper)[dof + i] = damper;
            world.row_of(a.qfrc_passive)[dof + i] = shared.passive[dof + i];
        }
    });
}

}
