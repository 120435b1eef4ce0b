// The moments of a batch, stage by stage, and their union with those of all before.

const size_t dim = a.dim, slots = a.parts + a.groups, size = slots * dim;
const float* values = (const float*)a.values;
unsigned char* counts = (unsigned char*)a.counts;
double *means = (double*)a.moments, *squares = means + size, *weights = squares + size;
const long long before = *(const long long*)a.count;
double weight = 0.0, mean = 0.0, square = 0.0;
auto merge = [&](int begin, int end) {
    double sum = 0.0;
    #pragma unroll 16
    for (int slot = begin; slot < end; ++slot) {
        weight += weights[slot];
        sum += weights[slot] * means[slot * dim + lane];
    }
    mean = sum / (weight > 1.0 ? weight : 1.0);
    #pragma unroll 16
    for (int slot = begin; slot < end; ++slot) {
        const double error = means[slot * dim + lane] - mean;
        square += squares[slot * dim + lane] + weights[slot] * error * error;
    }
};
auto store = [&](int slot) {
    means[slot * dim + lane] = mean;
    squares[slot * dim + lane] = square;
    if (lane == 0) weights[slot] = weight;
};
if (a.stage == 0) {
    // Threads of a GPU read neighbours, and whoever finds a fault writes the same.
    bool is_counted = a.until < 0 || before * a.ranks < a.until;
    if (a.valid) is_counted &= ((const unsigned char*)a.valid)[row] != 0;
    for (int i = 0; i < a.span; ++i) is_counted &= fabsf(values[row * dim + lane + i]) <= 3.402823466e38f;
    if (!is_counted) counts[row] = 0;
} else if (a.stage == 1) {
    const size_t begin = (size_t)row * a.rows, end = begin + a.rows < a.num_rows ? begin + a.rows : a.num_rows;
    double sum = 0.0;
    // All rows are read, counted or not, so that many reads are under way at once.
    #pragma unroll 8
    for (size_t i = begin; i < end; ++i) {
        const double value = values[i * dim + lane];
        weight += counts[i];
        sum += counts[i] ? value : 0.0;
    }
    mean = weight > 0.0 ? sum / weight : 0.0;
    #pragma unroll 8
    for (size_t i = begin; i < end; ++i) {
        const double value = values[i * dim + lane], error = counts[i] ? value - mean : 0.0;
        square += error * error;
    }
    store(row);
} else if (a.stage == 2) {
    const int begin = row * GROUP, end = begin + GROUP;
    merge(begin, end < a.parts ? end : a.parts);
    store(a.parts + row);
} else {
    merge(a.parts, (int)slots);
    // The union of both, as of those of ranks in `ranks.merged`.
    const double total = before + weight, share = weight / (total > 1.0 ? total : 1.0);
    double* exact_mean = (double*)a.mean + lane;
    const double delta = mean - *exact_mean;
    *exact_mean += delta * share;
    ((double*)a.squares)[lane] += square + delta * delta * share * before;
    if (lane == 0) weights[slots] = total;
}
