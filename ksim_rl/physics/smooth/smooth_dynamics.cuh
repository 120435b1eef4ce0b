// Smooth dynamics of one world. They follow MuJoCo's chapter on computation
// (https://mujoco.readthedocs.io/en/stable/computation/index.html) and engine_core_smooth.c, stage by stage, and add in
// one order whatever the number of lanes. Read the parts in their order: shared_memory.cuh, kinematics.cuh,
// inertia.cuh, velocities.cuh, passive.cuh, actuation.cuh.
//
// The lanes of a world, some of the threads of a warp, share out its bodies, joints, degrees of freedom or chains from
// a root to a leaf. What another lane reads next lies in shared memory.
#pragma once
#include "ksim_rl/physics/smooth/actuation.cuh"

namespace smooth_dynamics {

// All that follows from where bodies are.
CUDA_CALLABLE inline void go_on(const World& world, const Arguments& a, const SharedMemory& shared)
{
    write_poses(world, a, shared);
    place_dofs(world, a, shared);
    find_inertias(world, a, shared);
    find_velocities(world, a, shared);
    if (a.forces_too) {
        sum_forces(world, a, shared);
        fill_inertia(world, a, shared);
        find_passive_forces(world, a, shared);
        drive(world, a, shared);
        sum_smooth_forces(world, a, shared);
    } else if (a.sums_momenta)
        sum_momenta(world, a, shared);
}

CUDA_CALLABLE inline void run(int index, int lane, const Arguments& a)
{
#if defined(__CUDA_ARCH__)
    __shared__ __align__(16) float memory[FLOATS * (THREADS / LANES)];
    const SharedMemory shared(memory + (threadIdx.x / LANES) * FLOATS);
#else
    static float memory[FLOATS];
    const SharedMemory shared(memory);
#endif
    const World world = world_of(index, lane);
    if (!a.masked || a.mask.data[index]) {
        place_bodies(world, a, shared);
        if (a.places_geoms)
            place_geoms(world, a, shared);
        if (a.goes_on)
            go_on(world, a, shared);
    }
}

}
