// The noise of a row of readings, after the C++ of draws; kernel.py says what a column has, by its flags.

const int n = a.n, features = a.features, mode = a.mode;
const float* clean = (const float*)a.clean + (long long)row * n;
float* out = (float*)a.out + (long long)row * n;
float* bias = (float*)a.bias + (long long)row * n;
float* walk = (float*)a.walk + (long long)row * n;
float* last = (float*)a.last + (long long)row * n;
const float* table = (const float*)a.table;
const int* flags = (const int*)a.flags;
if (a.mask && !((const unsigned char*)a.mask)[row]) {
    for (int i = lane; i < n; i += LANES) out[i] = clean[i];
    return;
}
const long long seed = *(const long long*)a.seed;
long long* counter = (long long*)a.counter + (mode == 0 ? 0 : row);
const long long count = *counter + 1;
// The lanes of a row are one warp, so that all have read the count before it goes on.
SYNC
if (lane == 0 && mode != 0) *counter = count;
const float enabled = *(const unsigned char*)a.enabled ? 1.0f : 0.0f;
const float levelled = enabled * *(const float*)a.level;
const bool resets = mode == 2;

const RowKey key = key_of(seed, a.stream, count, a.first_row + row);
auto bits = [=](unsigned index) { return bits_of(key, index); };
auto sample = [&](int i, unsigned index, int parameter, bool is_normal, int features) {
    const unsigned b = bits(index);
    const float u = unit(b), z = features & 16 ? normal(b) : u;
    return table[parameter * n + i] + table[(parameter + 1) * n + i] * (is_normal ? z : u);
};
auto apply = [](float x, float noise, float strength, bool multiplies) {
    return x * (multiplies ? strength * noise + (1.0f - strength) : 1.0f) + (multiplies ? 0.0f : strength * noise);
};

auto column = [&](int i, int features) {
    const int flag = flags[i];
    const float strength = flag & 16 ? levelled : enabled;
    float x = clean[i];
    if (features & 1) {
        if (resets) bias[i] = sample(i, (unsigned)i + 0x40000000u, 2, flag & 4, features);
        x = apply(x, bias[i], strength, flag & 8);
    }
    if (features & 2) {
        const float drift = resets ? 0.0f : walk[i] + table[4 * n + i] * normal(bits((unsigned)i + 0x80000000u));
        walk[i] = drift;
        x += strength * drift;
    }
    x = apply(x, sample(i, (unsigned)i, 0, flag & 1, features), strength, flag & 2);
    if (features & 4) {
        const float step = strength * table[5 * n + i];
        x = step > 0.0f ? rintf(x / step) * step : x;
    }
    if (features & 8) {
        const float chance = resets ? 0.0f : strength * table[6 * n + i];
        const bool is_lost = unit(bits((unsigned)(flag >> 6) + 0xC0000000u)) < chance;
        x = is_lost ? (flag & 32 ? last[i] : 0.0f) : x;
        last[i] = x;
    }
    out[i] = x;
};
if (features == 0)
    for (int i = lane; i < n; i += LANES) column(i, 0);
else if (features == 16)
    for (int i = lane; i < n; i += LANES) column(i, 16);
else if (features == 17)
    for (int i = lane; i < n; i += LANES) column(i, 17);
else
    for (int i = lane; i < n; i += LANES) column(i, features);
