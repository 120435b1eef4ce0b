// Counts and least values that threads of a kernel share; the CPU has one thread at a time.
#pragma once
#include "builtin.h"

CUDA_CALLABLE inline void count_up(long long* count)
{
#if defined(__CUDA_ARCH__)
    atomicAdd((unsigned long long*)count, 1ull);
#else
    *count += 1;
#endif
}

// Keeps the least of values that are never negative.
CUDA_CALLABLE inline void keep_least(long long* kept, long long value)
{
#if defined(__CUDA_ARCH__)
    atomicMin((unsigned long long*)kept, (unsigned long long)value);
#else
    *kept = value < *kept ? value : *kept;
#endif
}
