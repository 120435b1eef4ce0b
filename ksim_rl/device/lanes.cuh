// How the lanes of a world share its work.
//
// The lanes of a world are some of the threads of a warp. Worlds of a warp have other numbers of contacts, so that lanes
// wait for lanes of their own world only. Whatever the number of lanes, each place in memory is written by the same
// formula, and sums are added in one order: the results have the same bits. The CPU has one lane.
#pragma once
#include "builtin.h"

namespace lanes {

namespace given {
constexpr int LANES = 1;    // of a world
constexpr int THREADS = 1;  // of a block
}

using namespace given;

// A world, as one of its lanes sees it.
struct World {
    int world, lane;

    // The row of this world in an array that has one for each world.
    template <class T>
    CUDA_CALLABLE T* row_of(const wp::array_t<T>& array) const
    {
        return array.data + (size_t)world * array.shape[1];
    }

    // The row of this world in a field of the model, which has one for each world or one for all.
    template <class T>
    CUDA_CALLABLE T* model_row(const wp::array_t<T>& array) const
    {
        return array.data + (array.shape[0] > 1 ? (size_t)world * array.shape[1] : 0);
    }

    // The same of one value for each world.
    template <class T>
    CUDA_CALLABLE T of_world(const wp::array_t<T>& array) const
    {
        return array.data[array.shape[0] > 1 ? world : 0];
    }

    // Calls work(item) for each item of so many that is this lane's.
    template <class Work>
    CUDA_CALLABLE void each(int count, Work work) const
    {
#pragma unroll 1
        for (int item = lane; item < count; item += LANES)
            work(item);
    }

    // The same, in a loop that compilers may unroll.
    template <class Work>
    CUDA_CALLABLE void share(int count, Work work) const
    {
        for (int item = lane; item < count; item += LANES)
            work(item);
    }
};

// Tells the compiler that there are so many lanes, or else it compiles loops over nothing.
CUDA_CALLABLE inline World world_of(int world, int lane)
{
#if defined(__CUDACC__) || defined(__clang__)
    __builtin_assume(lane >= 0 && lane < LANES);
#endif
    return World {world, lane};
}

#if defined(__CUDA_ARCH__)
// The lanes of this thread's world, as bits of its warp.
CUDA_CALLABLE inline unsigned own_lanes()
{
    return (LANES == 32 ? 0xffffffffu : (1u << (LANES % 32)) - 1u) << (threadIdx.x % 32 / LANES * LANES);
}
#endif

// Waits until all lanes of a world have written.
CUDA_CALLABLE inline void sync()
{
#if defined(__CUDA_ARCH__)
    __syncwarp(own_lanes());
#endif
}

// Waits for the whole warp, in kernels whose worlds take the same steps.
CUDA_CALLABLE inline void sync_warp()
{
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
}

// An item of a table that no kernel writes, so that it may be read ahead of what is written.
template <class T>
CUDA_CALLABLE inline T look_up(const wp::array_t<T>& table, int item)
{
#if defined(__CUDA_ARCH__)
    return __ldg(table.data + item);
#else
    return table.data[item];
#endif
}

// The value that another lane has.
template <class T>
CUDA_CALLABLE inline T of_lane(T value, int source)
{
#if defined(__CUDA_ARCH__)
    value = __shfl_sync(own_lanes(), value, source, LANES);
#endif
    return value;
}

// The sum of what the lanes before this one have.
CUDA_CALLABLE inline int sum_before(int lane, int value)
{
    int sum = value;
#if defined(__CUDA_ARCH__)
    for (int distance = 1; distance < LANES; distance *= 2) {
        const int other = __shfl_up_sync(own_lanes(), sum, distance, LANES);
        sum += lane >= distance ? other : 0;
    }
#endif
    return sum - value;
}

// How many lanes before this one have something, and how many all.
struct Count {
    int before, all;
};

CUDA_CALLABLE inline Count lanes_with(int lane, bool has)
{
#if defined(__CUDA_ARCH__)
    const unsigned with = (__ballot_sync(own_lanes(), has) & own_lanes()) >> (threadIdx.x % 32 / LANES * LANES);
    return Count {__popc(with & ((1u << lane) - 1u)), __popc(with)};
#else
    return Count {0, has};
#endif
}

// Takes places of a pool that all worlds share, for all lanes of a world, and returns the first: one lane each time, where
// all threads of all worlds would wait for the same counter.
CUDA_CALLABLE inline int take(int lane, int* counter, int count)
{
    int first = 0;
    if (lane == 0) {
#if defined(__CUDA_ARCH__)
        first = atomicAdd(counter, count);
#else
        first = *counter;
        *counter += count;
#endif
    }
    return of_lane(first, 0);
}

}
