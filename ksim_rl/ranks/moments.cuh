// The moments of a batch, stage by stage, and their union with the moments of all batches before.
#pragma once
#include "builtin.h"

namespace moments {

namespace given {
constexpr int GROUP = 32;  // parts whose moments one thread merges
}

struct Arguments {
    int stage;  // 0 to 3: of an element (which rows count), of a column of a part, of a group, and of the batch
    int num_rows;
    int dim;
    int rows;    // of a part
    int parts;
    int groups;  // of parts
    int ranks;
    int span;  // elements of a row that one thread of stage 0 looks at
    long long until;  // rows over all ranks after which none is counted; below 0 for no limit
    const float* values;
    const unsigned char* valid;  // null where all rows are
    unsigned char* counts;
    double* moments;  // means, then sums of squares, of each column of each part and group, then weights
    const long long* count;
    double* mean;
    double* squares;
};

// How many rows there are, and their mean and sum of squared deviations in one column.
struct Moments {
    double weight = 0.0, mean = 0.0, square = 0.0;
};

// Where the moments of a column lie, slot by slot: of parts, then of groups.
struct Slots {
    size_t dim;
    double* means;
    double* squares;
    double* weights;

    CUDA_CALLABLE Moments merged(int column, int begin, int end) const
    {
        Moments all;
        double sum = 0.0;
#pragma unroll 16
        for (int slot = begin; slot < end; ++slot) {
            all.weight += weights[slot];
            sum += weights[slot] * means[slot * dim + column];
        }
        all.mean = sum / (all.weight > 1.0 ? all.weight : 1.0);
#pragma unroll 16
        for (int slot = begin; slot < end; ++slot) {
            const double error = means[slot * dim + column] - all.mean;
            all.square += squares[slot * dim + column] + weights[slot] * error * error;
        }
        return all;
    }

    CUDA_CALLABLE void store(int column, int slot, const Moments& of) const
    {
        means[slot * dim + column] = of.mean;
        squares[slot * dim + column] = of.square;
        // The weight is the same in all columns.
        if (column == 0)
            weights[slot] = of.weight;
    }
};

CUDA_CALLABLE inline Slots slots_of(const Arguments& a)
{
    const size_t dim = a.dim, size = (a.parts + a.groups) * dim;
    double* means = a.moments;
    return Slots {dim, means, means + size, means + 2 * size};
}

// Stage 0: rows with a fault, or beyond the limit, do not count.
CUDA_CALLABLE inline void mark_row(int row, int column, const Arguments& a)
{
    // Threads of a GPU read neighbours, and whoever finds a fault writes the same.
    bool is_counted = a.until < 0 || *a.count * a.ranks < a.until;
    if (a.valid)
        is_counted &= a.valid[row] != 0;
    for (int i = 0; i < a.span; ++i)
        is_counted &= fabsf(a.values[row * (size_t)a.dim + column + i]) <= 3.402823466e38f;
    if (!is_counted)
        a.counts[row] = 0;
}

// Stage 1: the moments of a column in the rows of one part.
CUDA_CALLABLE inline Moments moments_of_part(int part, int column, const Arguments& a)
{
    const size_t dim = a.dim, begin = (size_t)part * a.rows;
    const size_t end = begin + a.rows < a.num_rows ? begin + a.rows : a.num_rows;
    Moments own;
    double sum = 0.0;
    // All rows are read, counted or not, so that many reads are under way at once.
#pragma unroll 8
    for (size_t i = begin; i < end; ++i) {
        const double value = a.values[i * dim + column];
        own.weight += a.counts[i];
        sum += a.counts[i] ? value : 0.0;
    }
    own.mean = own.weight > 0.0 ? sum / own.weight : 0.0;
#pragma unroll 8
    for (size_t i = begin; i < end; ++i) {
        const double value = a.values[i * dim + column], error = a.counts[i] ? value - own.mean : 0.0;
        own.square += error * error;
    }
    return own;
}

// Stage 3: the union of a batch with all batches before, as `ranks.merged` unites ranks.
CUDA_CALLABLE inline double unite(int column, long long before, const Moments& batch, const Arguments& a)
{
    const double total = before + batch.weight, share = batch.weight / (total > 1.0 ? total : 1.0);
    double* exact_mean = a.mean + column;
    const double delta = batch.mean - *exact_mean;
    *exact_mean += delta * share;
    a.squares[column] += batch.square + delta * delta * share * before;
    return total;
}

CUDA_CALLABLE inline void run(int row, int lane, const Arguments& a)
{
    const Slots slots = slots_of(a);
    const int num_slots = a.parts + a.groups;
    if (a.stage == 0)
        mark_row(row, lane, a);
    else if (a.stage == 1)
        slots.store(lane, row, moments_of_part(row, lane, a));
    else if (a.stage == 2) {
        const int begin = row * given::GROUP, end = begin + given::GROUP;
        slots.store(lane, a.parts + row, slots.merged(lane, begin, end < a.parts ? end : a.parts));
    } else {
        const double total = unite(lane, *a.count, slots.merged(lane, a.parts, num_slots), a);
        if (lane == 0)
            slots.weights[num_slots] = total;
    }
}

}
