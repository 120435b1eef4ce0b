// Counts a number of a table of terms that is not finite, by its term, and keeps where the first one was.
#pragma once
#include "ksim_rl/device/atomics.cuh"

namespace non_finite {

struct Arguments {
    int width;  // columns of the table
    int num_envs;
    const float* table;
    const int* term_of_column;
    const long long* step;
    long long* first;  // of each term, step * num_envs + env
    long long* count;  // of each term
};

CUDA_CALLABLE inline void run(int row, int column, const Arguments& a)
{
    const bool is_finite = fabsf(a.table[(long long)row * a.width + column]) <= 3.402823466e38f;
    if (!is_finite) {
        const int term = a.term_of_column[column];
        count_up(a.count + term);
        keep_least(a.first + term, *a.step * a.num_envs + row);
    }
}

}
