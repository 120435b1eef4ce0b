// The order in which the solver takes up worlds: those first that will take longest, by one block, which counts.
#pragma once
#include "builtin.h"

namespace sort_worlds {

constexpr int KEYS = 64;

struct Arguments {
    wp::array_t<int> order;
    wp::array_t<int> iterations;  // of the last substep
    wp::array_t<int> rows;        // of constraints
};

// The less, the longer a world will take.
CUDA_CALLABLE inline int key_of(int world, const Arguments& a)
{
    const int time = 2 * a.iterations.data[world] + a.rows.data[world] / 4;
    return KEYS - 1 - wp::min(time, KEYS - 1);
}

// The CPU takes worlds one after the other, and needs no order.
CUDA_CALLABLE inline void run(const Arguments& a)
{
#if defined(__CUDA_ARCH__)
    __shared__ int places[KEYS];  // how many worlds have a key, then where the next of them goes
    const int thread = threadIdx.x, threads = blockDim.x, worlds = a.order.shape[0];
    for (int key = thread; key < KEYS; key += threads)
        places[key] = 0;
    __syncthreads();
    for (int world = thread; world < worlds; world += threads)
        atomicAdd(places + key_of(world, a), 1);
    __syncthreads();
    if (thread == 0) {
        int before = 0;
        for (int key = 0; key < KEYS; ++key) {
            const int count = places[key];
            places[key] = before;
            before += count;
        }
    }
    __syncthreads();
    for (int world = thread; world < worlds; world += threads)
        a.order.data[atomicAdd(places + key_of(world, a), 1)] = world;
#endif
}

}
