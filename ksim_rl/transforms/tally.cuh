// Steps and rewards of a block of rows: counted on, or begun at 0 in the rows that reset, and copied.
//
// A GPU has a thread for each row. On the CPU one thread has all; its compiler takes parameters not to overlap, so that
// loops become vector instructions.
#pragma once
#include "builtin.h"

namespace tally {

struct Arguments {
    int rows;  // of a block
    const unsigned char* mask;  // the rows that reset; null in a step
    const float* reward;
    float* total;
    long long* step;
    float* total_out;
    long long* step_out;
};

template <class Number>
CUDA_CALLABLE inline void reset(
    int begin, int end, Number* __restrict__ kept, Number* __restrict__ out, const unsigned char* __restrict__ mask
)
{
    for (int row = begin; row < end; ++row)
        out[row] = kept[row] = mask[row] ? 0 : kept[row];
}

CUDA_CALLABLE inline void add(
    int begin, int end, float* __restrict__ kept, float* __restrict__ out, const float* __restrict__ reward
)
{
    for (int row = begin; row < end; ++row)
        out[row] = kept[row] = kept[row] + reward[row];
}

CUDA_CALLABLE inline void count(int begin, int end, long long* __restrict__ kept, long long* __restrict__ out)
{
    for (int row = begin; row < end; ++row)
        out[row] = kept[row] = kept[row] + 1;
}

CUDA_CALLABLE inline void run(int part, int, const Arguments& a)
{
    const int begin = part * a.rows, end = begin + a.rows;
    if (a.mask) {
        reset(begin, end, a.total, a.total_out, a.mask);
        reset(begin, end, a.step, a.step_out, a.mask);
    } else {
        add(begin, end, a.total, a.total_out, a.reward);
        count(begin, end, a.step, a.step_out);
    }
}

}
