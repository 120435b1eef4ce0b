// Part 3: velocities (mj_comVel), bias forces (mj_rne without accelerations) and the inertia matrix (mj_crb). A body
// accelerates with the one before it and by the rates of the axes that its own velocity turns; gravity is an
// acceleration of the world.
#pragma once
#include "ksim_rl/physics/smooth/inertia.cuh"

namespace smooth_dynamics {

CUDA_CALLABLE inline void find_velocities(const World& world, const Arguments& a, const Chip& chip)
{
    const float* const qvel = world.row_of(a.qvel);
    const spatial from_gravity = spatial_of(vec3(), GRAVITY ? -world.of_world(a.gravity) : vec3());
    if (world.lane == 0) {
        chip.velocity(0) = spatial();
        chip.force(0) = from_gravity;
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
                // A free joint's first three axes are those of the world, which nothing turns.
                if (type == FREE)
                    for (const int end = dof + 3; dof < end; ++dof) {
                        if (a.is_read)
                            world.row_of(a.cdof_dot)[dof] = spatial();
                        moving = moving + chip.motion(dof) * qvel[dof];
                    }
                // The axes of a ball turn together, with the velocity before all three.
                const int count = type == FREE || type == BALL ? 3 : 1;
                const spatial before = moving;
                for (const int end = dof + count; dof < end; ++dof) {
                    const spatial rate = cross_motion(before, chip.motion(dof));
                    if (a.is_read)
                        world.row_of(a.cdof_dot)[dof] = rate;
                    rising = rising + rate * qvel[dof];
                    moving = moving + chip.motion(dof) * qvel[dof];
                }
            }
            chip.velocity(body) = moving;
            chip.force(body) = rising;
        }
    });
    sync_warp();
    if (a.is_read)
        write(world, a.cvel, NUM_BODIES, chip.velocities, 6);
}

// Velocities and angular momenta of subtrees (mj_subtreeVel): summed about the centre of mass of all bodies.
CUDA_CALLABLE inline void sum_momenta(const World& world, const Arguments& a, const Chip& chip)
{
    world.each(NUM_BODIES, [&](int body) {
        const spatial own = times_inertia(chip.inertia(body), chip.velocity(body));
        const vec3 arm = chip.com(look_up(a.body_rootid, body)) - chip.com(0), pushed = translation_of(own);
        chip.force(body) = body == 0 ? spatial() : spatial_of(rotation_of(own) + wp::cross(arm, pushed), pushed);
    });
    sync_warp();
    sum_subtrees(world, 6, [&](int index) { return Column {chip.forces + index, 6}; });
    world.each(NUM_BODIES, [&](int body) {
        const vec3 pushed = translation_of(chip.force(body));
        world.row_of(a.subtree_linvel)[body] = pushed / wp::max(TINY, world.model_row(a.body_subtreemass)[body]);
        const vec3 offset = chip.com(body) - chip.com(0);
        world.row_of(a.subtree_angmom)[body] = rotation_of(chip.force(body)) - wp::cross(offset, pushed);
    });
}

// What bodies exert on their parents, and the inertias of subtrees.
CUDA_CALLABLE inline void sum_forces(const World& world, const Arguments& a, const Chip& chip)
{
    if (a.is_read)
        write(world, a.cacc, NUM_BODIES, chip.forces, 6);
    sync_warp();
    world.each(NUM_BODIES, [&](int body) {
        const spatial pushed = times_inertia(chip.inertia(body), chip.force(body));
        const spatial turned = cross_force(chip.velocity(body), times_inertia(chip.inertia(body), chip.velocity(body)));
        chip.force(body) = body == 0 ? spatial() : pushed + turned;
    });
    sync_warp();
    sum_subtrees(world, 16, [&](int index) {
        return index < 10 ? Column {chip.inertias + index, POSE} : Column {chip.forces + index - 10, 6};
    });
    if (a.is_read)
        write(world, a.cfrc_int, NUM_BODIES, chip.forces, 6);
    if (NUM_FREE_BODIES > 0)
        write(world, a.crb, NUM_BODIES, chip.inertias, POSE);  // the integration reads it
}

CUDA_CALLABLE inline void fill_inertia(const World& world, const Arguments& a, const Chip& chip)
{
    world.each(NUM_DOFS, [&](int dof) {
        chip.momentum(dof) = times_inertia(chip.inertia(look_up(a.dof_bodyid, dof)), chip.motion(dof));
    });
    sync_warp();
#pragma unroll 4
    for (int entry = world.lane; entry < a.M_hinit_i.shape[0]; entry += LANES) {
        const int row = look_up(a.M_hinit_i, entry), column = look_up(a.M_colind, entry);
        if (row != column)
            world.row_of(a.M)[entry] = wp::dot(chip.motion(column), chip.momentum(row));
    }
    world.each(NUM_DOFS, [&](int dof) {
        float armature = world.model_row(a.dof_armature)[dof];
        each_actuator_of(world, a, look_up(a.dof_jntid, dof), [&](int actuator) {
            const float gear = world.model_row(a.actuator_gear)[actuator][0];
            armature += world.model_row(a.actuator_armature)[actuator] * gear * gear;
        });
        const int entry = look_up(a.M_rowadr, dof) + look_up(a.M_rownnz, dof) - 1;
        world.row_of(a.M)[entry] = wp::dot(chip.motion(dof), chip.momentum(dof)) + armature;
    });
}

}
