// The integration of one world. Read the parts in their order: derivative.cuh, factorization.cuh, free_bodies.cuh,
// advance.cuh.
#pragma once
#include "ksim_rl/physics/smooth/advance.cuh"

namespace integration {

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
    if (SOLVES) {
        fill_system(world, a, shared);
        solve(world, a, shared);
        solve_free_bodies(world, a, shared);
    } else
        keep_accelerations(world, a, shared);
    advance(world, a, shared);
    if (lane == 0) {
        a.time.data[index] += world.of_world(a.timestep);
        note_overflow(world, a);
    }
}

}
