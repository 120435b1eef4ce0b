// The noise of a row of readings; kernel.py says what a column has, by its flags.
#pragma once
#include "ksim_rl/device/draws.cuh"

namespace noise {

using namespace draws;

namespace given {
constexpr int GPU_LANES = 32;  // of a row, on a GPU
// Features that at least one column has.
constexpr int HAS_BIAS = 1;
constexpr int HAS_WALK = 2;
constexpr int HAS_RESOLUTION = 4;
constexpr int HAS_DROPOUT = 8;
constexpr int HAS_GAUSSIAN = 16;
// Flags of a column; the bits above them are the number of its observation.
constexpr int GAUSSIAN = 1;
constexpr int MULTIPLY = 2;
constexpr int BIAS_GAUSSIAN = 4;
constexpr int BIAS_MULTIPLY = 8;
constexpr int BY_LEVEL = 16;
constexpr int HOLD = 32;
constexpr int KEY_SHIFT = 6;
// Rows of the table of parameters; a spread follows its offset.
constexpr int OFFSET = 0;
constexpr int BIAS_OFFSET = 2;
constexpr int WALK_STD = 4;
constexpr int RESOLUTION = 5;
constexpr int DROPOUT = 6;
}

using namespace given;

// Where the draws of biases, of drifts and of lost readings begin among the draws of a row, as in kernel.py.
constexpr unsigned BIAS_INDEX = 0x40000000u, WALK_INDEX = 0x80000000u, DROPOUT_INDEX = 0xC0000000u;

#if defined(__CUDA_ARCH__)
constexpr int LANES = GPU_LANES;
#else
constexpr int LANES = 1;
#endif

struct Arguments {
    int n;         // columns
    int mode;      // 0 to 2: samples, a step, a reset
    int features;  // that at least one column has
    int first_row;  // of this rank
    unsigned stream;
    const long long* seed;
    long long* counter;  // of each row, or of all in mode 0
    const unsigned char* enabled;
    const float* level;
    const unsigned char* mask;  // the rows that reset; null for all
    const float* table;         // rows of parameters, of which each column has one number
    const int* flags;           // of each column
    const float* clean;
    float* bias;
    float* walk;
    float* last;
    float* out;
};

// A reading with noise of a strength added, or multiplied by.
CUDA_CALLABLE inline float applied(float x, float noise, float strength, bool multiplies)
{
    return x * (multiplies ? strength * noise + (1.0f - strength) : 1.0f) + (multiplies ? 0.0f : strength * noise);
}

// What the lanes of a row know of it.
struct Row {
    RowKey key;
    int n;
    bool resets;
    float enabled;   // the strength of columns, and of those that follow a level
    float levelled;
    const float* table;
    const int* flags;
    const float* clean;
    float* bias;
    float* walk;
    float* last;
    float* out;

    CUDA_CALLABLE float sample(int i, unsigned index, int parameter, bool is_normal, int features) const
    {
        const unsigned bits = bits_of(key, index);
        const float u = unit(bits), z = features & HAS_GAUSSIAN ? normal(bits) : u;
        return table[parameter * n + i] + table[(parameter + 1) * n + i] * (is_normal ? z : u);
    }

    // Writes a noisy reading. Where the features are a constant, all else is compiled out.
    CUDA_CALLABLE void write(int i, int features) const
    {
        const int flag = flags[i];
        const float strength = flag & BY_LEVEL ? levelled : enabled;
        float x = clean[i];
        if (features & HAS_BIAS) {
            if (resets)
                bias[i] = sample(i, (unsigned)i + BIAS_INDEX, BIAS_OFFSET, flag & BIAS_GAUSSIAN, features);
            x = applied(x, bias[i], strength, flag & BIAS_MULTIPLY);
        }
        if (features & HAS_WALK) {
            const unsigned bits = bits_of(key, (unsigned)i + WALK_INDEX);
            const float drift = resets ? 0.0f : walk[i] + table[WALK_STD * n + i] * normal(bits);
            walk[i] = drift;
            x += strength * drift;
        }
        x = applied(x, sample(i, (unsigned)i, OFFSET, flag & GAUSSIAN, features), strength, flag & MULTIPLY);
        if (features & HAS_RESOLUTION) {
            const float step = strength * table[RESOLUTION * n + i];
            x = step > 0.0f ? rintf(x / step) * step : x;
        }
        if (features & HAS_DROPOUT) {
            const float chance = resets ? 0.0f : strength * table[DROPOUT * n + i];
            const bool is_lost = unit(bits_of(key, (unsigned)(flag >> KEY_SHIFT) + DROPOUT_INDEX)) < chance;
            x = is_lost ? (flag & HOLD ? last[i] : 0.0f) : x;
            last[i] = x;
        }
        out[i] = x;
    }
};

// The lanes of a row are one warp.
CUDA_CALLABLE inline void wait_for_row()
{
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
}

CUDA_CALLABLE inline void add_noise(int row, int lane, const Arguments& a)
{
    const int n = a.n, features = a.features;
    const long long seed = *a.seed;
    long long* counter = a.counter + (a.mode == 0 ? 0 : row);
    const long long count = *counter + 1;
    // All have read the count before it goes on.
    wait_for_row();
    if (lane == 0 && a.mode != 0)
        *counter = count;
    Row own;
    own.enabled = *a.enabled ? 1.0f : 0.0f;
    own.levelled = own.enabled * *a.level;
    own.resets = a.mode == 2;
    own.key = key_of(seed, a.stream, count, a.first_row + row);
    own.n = n;
    own.table = a.table;
    own.flags = a.flags;
    own.clean = a.clean + (long long)row * n;
    own.bias = a.bias + (long long)row * n;
    own.walk = a.walk + (long long)row * n;
    own.last = a.last + (long long)row * n;
    own.out = a.out + (long long)row * n;
    // The common combinations have loops of their own.
    if (features == 0)
        for (int i = lane; i < n; i += LANES)
            own.write(i, 0);
    else if (features == HAS_GAUSSIAN)
        for (int i = lane; i < n; i += LANES)
            own.write(i, HAS_GAUSSIAN);
    else if (features == (HAS_GAUSSIAN | HAS_BIAS))
        for (int i = lane; i < n; i += LANES)
            own.write(i, HAS_GAUSSIAN | HAS_BIAS);
    else
        for (int i = lane; i < n; i += LANES)
            own.write(i, features);
}

CUDA_CALLABLE inline void run(int row, int lane, const Arguments& a)
{
    if (!a.mask || a.mask[row]) {
        add_noise(row, lane, a);
        return;
    }
    // At a reset the other rows keep their clean readings.
    const long long first = (long long)row * a.n;
    for (int i = lane; i < a.n; i += LANES)
        a.out[first + i] = a.clean[first + i];
}

}
