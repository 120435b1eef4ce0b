// What the C++ of generated kernels calls: functions of torch, draws, and counts that rows share.
#pragma once
#include "ksim_rl/device/atomics.cuh"
#include "ksim_rl/device/draws.cuh"

namespace row_formulas {

// The larger and the smaller of two numbers, or x where that is no number.
template <class X, class Y>
CUDA_CALLABLE inline X high(X x, Y y)
{
    return x > y || x != x ? x : (X)y;
}

template <class X, class Y>
CUDA_CALLABLE inline X low(X x, Y y)
{
    return x < y || x != x ? x : (X)y;
}

// Exact to rounding, by W. Kahan; not every compiler's library has these two.
template <class X>
CUDA_CALLABLE inline X log_1_plus(X x)
{
    const auto u = 1 + x;
    return u == 1 ? x : u - 1 == u ? log(u) : log(u) * x / (u - 1);
}

template <class X>
CUDA_CALLABLE inline X exp_less_1(X x)
{
    const auto u = exp(x);
    return u == 1 ? x : u - 1 == u ? u : u - 1 == -1 ? (X)-1 : (X)((u - 1) * x / log(u));
}

// The remainder of a division, with the sign of the divisor.
template <class X, class Y>
CUDA_CALLABLE inline X modulo(X x, Y y)
{
    auto rest = (X)(x - (X)(long long)(x / y) * y);
    // Of real numbers.
    if constexpr ((X)0.5 != 0)
        rest = (X)fmod(x, y);
    return rest != 0 && (rest < 0) != (y < 0) ? (X)(rest + y) : rest;
}

}
