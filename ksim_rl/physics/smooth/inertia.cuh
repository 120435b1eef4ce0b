// Part 2: centres of mass, the axes of the degrees of freedom, and inertias, all at them (mj_comPos).
#pragma once
#include "ksim_rl/physics/smooth/kinematics.cuh"

namespace smooth_dynamics {

struct Column {
    float* data;
    int stride;
};

// Adds to each body's parent, from the last body to the first, what lies in shared memory; a lane has a column of it.
// The parents are constants, so that sums stay in registers.
template <class ColumnOf>
CUDA_CALLABLE inline void sum_subtrees(const World& world, int columns, ColumnOf column_of)
{
    world.each(columns, [&](int index) {
        const Column column = column_of(index);
#pragma unroll UNROLLED_BODIES
        for (int body = NUM_BODIES - 1; body > 0; --body)
            column.data[PARENTS[body] * column.stride] += column.data[body * column.stride];
    });
    sync_warp();
}

CUDA_CALLABLE inline void place_dofs(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float* const mass = world.model_row(a.body_mass);
    world.each(NUM_BODIES, [&](int body) { shared.com(body) = mass[body] * shared.center(body); });
    sync_warp();
    sum_subtrees(world, 3, [&](int index) { return Column {shared.coms + index, 3}; });
    world.each(NUM_BODIES, [&](int body) {
        const float total = world.model_row(a.body_subtreemass)[body];
        shared.com(body) = total < TINY ? shared.center(body) : shared.com(body) / total;
    });
    sync_warp();
    write(world, a.subtree_com, NUM_BODIES, shared.coms, 3);

    world.each(NUM_JOINTS, [&](int joint) {
        const int body = look_up(a.jnt_bodyid, joint), type = look_up(a.jnt_type, joint);
        int dof = look_up(a.jnt_dofadr, joint);
        const vec3 offset = shared.com(look_up(a.body_rootid, body)) - shared.anchor(joint);
        if (type == SLIDE)
            shared.motion(dof) = spatial_of(vec3(), shared.axis(joint));
        else if (type == HINGE)
            shared.motion(dof) = spatial_of(shared.axis(joint), wp::cross(shared.axis(joint), offset));
        else {
            const mat33 frame = matrix(shared.turn(body));
            for (int i = 0; i < (type == FREE ? 3 : 0); ++i, ++dof) {
                const vec3 along(i == 0 ? 1.0f : 0.0f, i == 1 ? 1.0f : 0.0f, i == 2 ? 1.0f : 0.0f);
                shared.motion(dof) = spatial_of(vec3(), along);
            }
            for (int i = 0; i < 3; ++i, ++dof) {
                const vec3 column(frame.data[0][i], frame.data[1][i], frame.data[2][i]);
                shared.motion(dof) = spatial_of(column, wp::cross(column, offset));
            }
        }
    });
    sync_warp();
    write(world, a.cdof, NUM_DOFS, shared.motions, 6);
}

CUDA_CALLABLE inline void find_inertias(const World& world, const Arguments& a, const SharedMemory& shared)
{
    const float* const mass = world.model_row(a.body_mass);
    world.each(NUM_BODIES, [&](int body) {
        const mat33 frame = inertial_frame(world, a, shared, body);
        const vec3 moments = world.model_row(a.body_inertia)[body];
        const vec3 offset = shared.center(body) - shared.com(look_up(a.body_rootid, body));
        auto turned = [&](int i, int j) {
            float sum = 0.0f;
            for (int k = 0; k < 3; ++k)
                sum += frame.data[i][k] * moments[k] * frame.data[j][k];
            return sum;
        };
        const vec3 moment = mass[body] * offset;
        inertia10 found;
        found[0] = turned(0, 0) + moment[1] * offset[1] + moment[2] * offset[2];
        found[1] = turned(1, 1) + moment[0] * offset[0] + moment[2] * offset[2];
        found[2] = turned(2, 2) + moment[0] * offset[0] + moment[1] * offset[1];
        found[3] = turned(0, 1) - moment[0] * offset[1];
        found[4] = turned(0, 2) - moment[0] * offset[2];
        found[5] = turned(1, 2) - moment[1] * offset[2];
        for (int i = 0; i < 3; ++i)
            found[6 + i] = moment[i];
        found[9] = mass[body];
        shared.inertia(body) = found;
    });
    sync_warp();
    if (a.is_read)
        write(world, a.cinert, NUM_BODIES, shared.inertias, POSE);
}

}
