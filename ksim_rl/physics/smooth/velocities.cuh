// Part 3: velocities (mj_comVel), bias forces (mj_rne without accelerations) and the inertia matrix (mj_crb). A body
// accelerates with the one before it and by the rates of the axes that its own velocity turns; gravity is an
// acceleration of the world.
#pragma once
#include "ksim_rl/physics/smooth/inertia.cuh"

namespace smooth_dynamics {

CUDA_CALLABLE inline void find_velocities(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float* const qvel = world.row_of(a.qvel);
    const spatial from_gravity = spatial_of(vec3(), GRAVITY ? -world.of_world(a.gravity) : vec3());
    if (world.lane == 0) {
        shared.velocity(0) = spatial();
        shared.force(0) = from_gravity;
    }
    world.each(NUM_CHAINS, [&](int chain) {
        spatial moving, rising = from_gravity;
#pragma unroll 1
        for (int link = first_link(a, chain); link < first_link(a, chain + 1); ++link) {
            const int body = look_up(a.body_branches, link), first = look_up(a.body_jntadr, body);
            int dof = look_up(a.body_dofadr, body);
#pragma unroll 1
            for (int joint = first; joint < first + look_up(a.body_jntnum, body); ++joint) {
                const int type = look_up(a.jnt_type, joint);
                // A free joint's first three axes are the world's, which nothing turns.
                if (type == FREE)
                    for (const int end = dof + 3; dof < end; ++dof) {
                        if (a.is_read)
                            world.row_of(a.cdof_dot)[dof] = spatial();
                        moving = moving + shared.motion(dof) * qvel[dof];
                    }
                // The axes of a ball turn together, with the velocity before all three.
                const int count = type == FREE || type == BALL ? 3 : 1;
                const spatial before = moving;
                for (const int end = dof + count; dof < end; ++dof) {
                    const spatial rate = cross_motion(before, shared.motion(dof));
                    if (a.is_read)
                        world.row_of(a.cdof_dot)[dof] = rate;
                    rising = rising + rate * qvel[dof];
                    moving = moving + shared.motion(dof) * qvel[dof];
                }
            }
            shared.velocity(body) = moving;
            shared.force(body) = rising;
        }
    });
    sync_warp();
    if (a.is_read)
        write(world, a.cvel, NUM_BODIES, shared.velocities, 6);
}

// Velocities and angular momenta of subtrees (mj_subtreeVel): summed about the centre of mass of all bodies.
CUDA_CALLABLE inline void sum_momenta(const World& world, const Arguments& a, const SharedMemory& shared)
{
    world.each(NUM_BODIES, [&](int body) {
        const spatial own = times_inertia(shared.inertia(body), shared.velocity(body));
        const vec3 arm = shared.com(look_up(a.body_rootid, body)) - shared.com(0), pushed = translation_of(own);
        shared.force(body) = body == 0 ? spatial() : spatial_of(rotation_of(own) + wp::cross(arm, pushed), pushed);
    });
    sync_warp();
    sum_subtrees(world, 6, [&](int index) { return Column {shared.forces + index, 6}; });
    world.each(NUM_BODIES, [&](int body) {
        const vec3 pushed = translation_of(shared.force(body));
        world.row_of(a.subtree_linvel)[body] = pushed / wp::max(TINY, world.model_row(a.body_subtreemass)[body]);
        const vec3 offset = shared.com(body) - shared.com(0);
        world.row_of(a.subtree_angmom)[body] = rotation_of(shared.force(body)) - wp::cross(offset, pushed);
    });
}

// What bodies exert on their parents, and the inertias of subtrees.
CUDA_CALLABLE inline void sum_forces(const World& world, const Arguments& a, const SharedMemory& shared)
{
    if (a.is_read)
        write(world, a.cacc, NUM_BODIES, shared.forces, 6);
    sync_warp();
    world.each(NUM_BODIES, [&](int body) {
        const spatial pushed = times_inertia(shared.inertia(body), shared.force(body));
        const spatial turned
            = cross_force(shared.velocity(body), times_inertia(shared.inertia(body), shared.velocity(body)));
        shared.force(body) = body == 0 ? spatial() : pushed + turned;
    });
    sync_warp();
    sum_subtrees(world, 16, [&](int index) {
        return index < 10 ? Column {shared.inertias + index, POSE} : Column {shared.forces + index - 10, 6};
    });
    if (a.is_read)
        write(world, a.cfrc_int, NUM_BODIES, shared.forces, 6);
    if (NUM_FREE_BODIES > 0)
        write(world, a.crb, NUM_BODIES, shared.inertias, POSE);  // the integration reads it
}

CUDA_CALLABLE inline void fill_inertia(const World& world, const Arguments& a, const SharedMemory& shared)
{
    world.each(NUM_DOFS, [&](int dof) {
        shared.momentum(dof) = times_inertia(shared.inertia(look_up(a.dof_bodyid, dof)), shared.motion(dof));
    });
    sync_warp();
#pragma unroll 4
    for (int entry = world.lane; entry < a.M_hinit_i.shape[0]; entry += LANES) {
        const int row = look_up(a.M_hinit_i, entry), column = look_up(a.M_colind, entry);
        if (row != column)
            world.row_of(a.M)[entry] = wp::dot(shared.motion(column), shared.momentum(row));
    }
    world.each(NUM_DOFS, [&](int dof) {
        float armature = world.model_row(a.dof_armature)[dof];
        each_actuator_of(a, look_up(a.dof_jntid, dof), [&](int actuator) {
            const float gear = world.model_row(a.actuator_gear)[actuator][0];
            armature += world.model_row(a.actuator_armature)[actuator] * gear * gear;
        });
        const int entry = look_up(a.M_rowadr, dof) + look_up(a.M_rownnz, dof) - 1;
        world.row_of(a.M)[entry] = wp::dot(shared.motion(dof), shared.momentum(dof)) + armature;
    });
}

}
