// What the lanes of a world, on CUDA a whole warp, tell each other, and arithmetic that stays finite.
#pragma once
#include "ksim_rl/physics/newton/arguments.cuh"

namespace newton {

// The sum of what all lanes have.
CUDA_CALLABLE inline float total(float value)
{
#if defined(__CUDA_ARCH__)
UNROLL
    for (int distance = LANES / 2; distance > 0; distance >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, distance);
    // A fused multiply-add may round the first sum otherwise in each lane: one of them speaks for all.
    value = __shfl_sync(0xffffffffu, value, 0);
#endif
    return value;
}

// What each lane has of four sums, added up over `count` neighbours, of which lane i then has the i-th. Lanes exchange
// what they do not go on with, so that a warp shuffles 6 times where four sums, one by one, take 20.
CUDA_CALLABLE inline float pooled(int lane, float a, float b, float c, float d, int count)
{
#if defined(__CUDA_ARCH__)
    const bool odd = lane & 1, late = lane & 2;
    const float ab = (odd ? b : a) + __shfl_xor_sync(0xffffffffu, odd ? a : b, 1);
    const float cd = (odd ? d : c) + __shfl_xor_sync(0xffffffffu, odd ? c : d, 1);
    a = (late ? cd : ab) + __shfl_xor_sync(0xffffffffu, late ? ab : cd, 2);
UNROLL
    for (int distance = 4; distance < count; distance <<= 1)
        a += __shfl_xor_sync(0xffffffffu, a, distance);
#endif
    return a;
}

// The lanes for which it holds, a bit for each.
CUDA_CALLABLE inline unsigned lanes_where(bool holds)
{
#if defined(__CUDA_ARCH__)
    return __ballot_sync(0xffffffffu, holds);
#else
    return holds;
#endif
}

CUDA_CALLABLE inline int count_of(unsigned some_lanes)
{
#if defined(__CUDA_ARCH__)
    return __popc(some_lanes);
#else
    return some_lanes;
#endif
}

CUDA_CALLABLE inline int first_of(unsigned some_lanes)
{
#if defined(__CUDA_ARCH__)
    return __ffs(some_lanes) - 1;
#else
    return 0;
#endif
}

// The value of the lane so far away.
CUDA_CALLABLE inline float across(float value, int distance)
{
#if defined(__CUDA_ARCH__)
    value = __shfl_xor_sync(0xffffffffu, value, distance);
#endif
    return value;
}

// What overflows in one tree stays there: in the sums of another tree infinity times zero would be NaN.
CUDA_CALLABLE inline float bounded(float value)
{
    return wp::clamp(value, -LARGEST, LARGEST);
}

CUDA_CALLABLE inline float ratio(float dividend, float divisor)
{
    return dividend / (divisor == 0.0f ? TINY : divisor);
}

}
