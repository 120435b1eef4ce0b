// One block of rows and columns of a draw, after draws.cpp; `kind` is that of random.py.

const long long seed = *(const long long*)a.seed;
const long long* __restrict__ counter = (const long long*)a.counter;
const int begin_row = part * a.rows, begin = chunk * a.columns, n = a.n, stride = a.counter_stride;
const int first = a.first_row, end_row = begin_row + a.rows, end = begin + a.columns;
const unsigned stream = a.stream;
auto fill = [&](auto write) {
    for (int row = begin_row; row < end_row; ++row) {
        const RowKey key = key_of(seed, stream, counter[row * stride], first + row);
        for (int i = begin; i < end; ++i) write((long long)row * n + i, bits_of(key, (unsigned)i));
    }
};
auto fill_one_each = [&](auto write) {
    for (int row = begin_row; row < end_row; ++row)
        write(row, bits_of(key_of(seed, stream, counter[row * stride], first + row), 0u));
};
auto run = [&](auto write) { n == 1 ? fill_one_each(write) : fill(write); };
float* __restrict__ reals = (float*)a.out;
long long* __restrict__ integers = (long long*)a.out;
const float low = a.low, high = a.high;
const long long start = a.start;
const unsigned long long span = (unsigned long long)a.span;
if (a.kind == 0) run([=](long long at, unsigned b) { reals[at] = low + unit(b) * (high - low); });
else if (a.kind == 1) run([=](long long at, unsigned b) { reals[at] = normal(b); });
else if (a.kind == 2) run([=](long long at, unsigned b) { integers[at] = start + (long long)((b * span) >> 32); });
else for (int row = begin_row; row < end_row; ++row) {
    // A bijection of the next power of two; what it takes past the last number goes through it again (Black and
    // Rogaway, "Ciphers with arbitrary finite domains", 2002).
    const RowKey key = key_of(seed, stream, counter[row / stride], first + row % stride);
    unsigned low_bits = start / 2, low_mask = (1u << low_bits) - 1u, high_mask = (1u << (start - low_bits)) - 1u;
    unsigned round_keys[24];
    for (int round = 0; round < (int)span; ++round) round_keys[round] = bits_of(key, (unsigned)round);
    for (int i = begin; i < end; ++i) {
        unsigned number = i;
        do {
            unsigned low = number & low_mask, high = number >> low_bits;
            for (int round = 0; round < (int)span; round += 2) {
                low ^= mix(high ^ round_keys[round]) & low_mask;
                high ^= mix(low ^ round_keys[round + 1]) & high_mask;
            }
            number = (high << low_bits) | low;
        } while (number >= (unsigned)n);
        integers[(long long)row * n + i] = (long long)(row % stride) * n + number;
    }
}
