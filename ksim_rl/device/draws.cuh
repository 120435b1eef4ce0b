// Random numbers of all kernels that draw, by hashes of their coordinates; random.py has the sources.
#pragma once
#include "builtin.h"

namespace draws {

constexpr unsigned GOLDEN = 0x9E3779B9u;  // 2^32 by the golden ratio

// Each bit of the result depends on each bit of x.
CUDA_CALLABLE inline unsigned mix(unsigned x)
{
    x = (x ^ (x >> 16)) * 0x21F0AAADu;
    x = (x ^ (x >> 15)) * 0xD35A2D97u;
    return x ^ (x >> 15);
}

struct RowKey {
    unsigned first, second;
};

CUDA_CALLABLE inline RowKey key_of(long long seed, unsigned stream, long long count, int row)
{
    const unsigned low = (unsigned)count, high = (unsigned)((unsigned long long)count >> 32);
    const unsigned base = mix((unsigned)(seed ^ (seed >> 32)) ^ stream);
    const unsigned first = mix(base + low * GOLDEN) ^ mix((unsigned)row + high + 1u);
    const unsigned second = mix(first + (unsigned)row * GOLDEN + GOLDEN) ^ mix(low + stream);
    return RowKey {mix(first), mix(second)};
}

// 32 random bits, of which a row has as many as there are indices.
CUDA_CALLABLE inline unsigned bits_of(RowKey key, unsigned index)
{
    return mix(mix(key.first ^ ((index + 1u) * GOLDEN)) ^ key.second);
}

// Uniform on [0, 1), in steps of 2^-24.
CUDA_CALLABLE inline float unit(unsigned bits)
{
    return (float)(bits >> 8) * 5.9604644775390625e-08f;
}

// A polynomial in x, from the coefficient of the highest power on.
template <class... Coefficients>
CUDA_CALLABLE inline float horner(float x, float sum, Coefficients... coefficients)
{
    ((sum = sum * x + coefficients), ...);
    return sum;
}

// Standard normal: sqrt(2) erfinv(x), after M. Giles, of a logarithm that each compiler rounds the same.
CUDA_CALLABLE inline float normal(unsigned bits)
{
    const float x = ((float)((int)(bits >> 8) - 8388608) + 0.5f) * 1.1920928955078125e-07f;
    const float t = (1.0f - x) * (1.0f + x);
    // t is 2^exponent times a mantissa of sqrt(1/2) to sqrt(2).
    unsigned word;
    memcpy(&word, &t, 4);
    int exponent = (int)(word >> 23) - 127;
    word = (word & 0x7FFFFFu) | 0x3F800000u;
    float mantissa;
    memcpy(&mantissa, &word, 4);
    const bool is_large = mantissa > 1.41421356f;
    exponent += is_large;
    const float f = (is_large ? 0.5f * mantissa : mantissa) - 1.0f;
    const float s = horner(
        f, 7.0376836292e-2f, -1.1514610310e-1f, 1.1676998740e-1f, -1.2420140846e-1f, 1.4249322787e-1f,
        -1.6668057665e-1f, 2.0000714765e-1f, -2.4999993993e-1f, 3.3333331174e-1f
    );
    const float w = -(f + f * f * (s * f - 0.5f) + (float)exponent * 0.693147180559945f);
    // In the middle, and in the tails.
    const float p = horner(
        w - 2.5f, 2.81022636e-08f, 3.43273939e-07f, -3.5233877e-06f, -4.39150654e-06f, 2.1858087e-04f,
        -1.25372503e-03f, -4.17768164e-03f, 2.46640727e-01f, 1.50140941f
    );
    const float d = sqrtf(w < 5.0f ? 5.0f : w) - 3.0f;
    const float q = horner(
        d, -2.00214257e-04f, 1.00950558e-04f, 1.34934322e-03f, -3.67342844e-03f, 5.73950773e-03f,
        -7.6224613e-03f, 9.43887047e-03f, 1.00167406f, 2.83297682f
    );
    return 1.41421356237f * x * (w < 5.0f ? p : q);
}

}
