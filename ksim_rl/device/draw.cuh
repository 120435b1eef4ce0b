// One block of rows and columns of a draw. A GPU has a thread for each number; on the CPU one thread has a block of all.
#pragma once
#include "ksim_rl/device/draws.cuh"

namespace draw {

using namespace draws;

struct Arguments {
    int rows;  // of a block
    int columns;
    int n;     // numbers of a row
    int kind;  // as in random.py: uniform, normal, whole numbers, and orders
    float low;
    float high;
    long long start;  // the least whole number; of orders, bits of a number
    long long span;   // how many whole numbers there are; of orders, the rounds of the cipher
    unsigned stream;
    int counter_stride;  // from the count of a row to the next count; of orders, the rows of a count
    int first_row;       // of this rank
    const long long* seed;
    const long long* counter;
    void* out;  // float or long long
};

// The rows and columns of this thread.
struct Block {
    int begin_row, end_row, begin, end;
};

// Calls write(place, bits) for each number of a block.
template <class Write>
CUDA_CALLABLE inline void fill(const Block& block, const Arguments& a, Write write)
{
    const long long* __restrict__ counter = a.counter;
    const long long seed = *a.seed;
    // With one number for each row the loop over rows becomes vector instructions.
    if (a.n == 1) {
        for (int row = block.begin_row; row < block.end_row; ++row) {
            const RowKey key = key_of(seed, a.stream, counter[row * a.counter_stride], a.first_row + row);
            write(row, bits_of(key, 0u));
        }
        return;
    }
    for (int row = block.begin_row; row < block.end_row; ++row) {
        const RowKey key = key_of(seed, a.stream, counter[row * a.counter_stride], a.first_row + row);
        for (int i = block.begin; i < block.end; ++i)
            write((long long)row * a.n + i, bits_of(key, (unsigned)i));
    }
}

// Orders of the numbers below n: a bijection of the next power of two; what it takes past the last number goes through it
// again (Black and Rogaway, "Ciphers with arbitrary finite domains", 2002).
CUDA_CALLABLE inline void fill_orders(const Block& block, const Arguments& a)
{
    long long* __restrict__ integers = (long long*)a.out;
    const int stride = a.counter_stride, rounds = (int)(unsigned long long)a.span;
    for (int row = block.begin_row; row < block.end_row; ++row) {
        const RowKey key = key_of(*a.seed, a.stream, a.counter[row / stride], a.first_row + row % stride);
        const unsigned low_bits = a.start / 2, low_mask = (1u << low_bits) - 1u;
        const unsigned high_mask = (1u << (a.start - low_bits)) - 1u;
        unsigned round_keys[24];
        for (int round = 0; round < rounds; ++round)
            round_keys[round] = bits_of(key, (unsigned)round);
        for (int i = block.begin; i < block.end; ++i) {
            unsigned number = i;
            do {
                unsigned low = number & low_mask, high = number >> low_bits;
                for (int round = 0; round < rounds; round += 2) {
                    low ^= mix(high ^ round_keys[round]) & low_mask;
                    high ^= mix(low ^ round_keys[round + 1]) & high_mask;
                }
                number = (high << low_bits) | low;
            } while (number >= (unsigned)a.n);
            integers[(long long)row * a.n + i] = (long long)(row % stride) * a.n + number;
        }
    }
}

CUDA_CALLABLE inline void run(int part, int chunk, const Arguments& a)
{
    const int begin_row = part * a.rows, begin = chunk * a.columns;
    const Block block {begin_row, begin_row + a.rows, begin, begin + a.columns};
    float* __restrict__ reals = (float*)a.out;
    long long* __restrict__ integers = (long long*)a.out;
    const float low = a.low, high = a.high;
    const long long start = a.start;
    const unsigned long long span = (unsigned long long)a.span;
    if (a.kind == 0)
        fill(block, a, [=](long long at, unsigned bits) { reals[at] = low + unit(bits) * (high - low); });
    else if (a.kind == 1)
        fill(block, a, [=](long long at, unsigned bits) { reals[at] = normal(bits); });
    else if (a.kind == 2)
        fill(block, a, [=](long long at, unsigned bits) { integers[at] = start + (long long)((bits * span) >> 32); });
    else
        fill_orders(block, a);
}

}
