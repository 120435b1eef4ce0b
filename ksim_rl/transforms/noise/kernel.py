"""This module adds noise to all observations of a transform by one kernel, which is also a torch operator.

Each column's draws are those of `ksim_rl.device.random` at (seed, stream, counter, row, column).
"""

import torch
import warp as wp
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.device.quick_launch import QuickLaunch, address, arguments_of, as_operator
from ksim_rl.device.random import DRAWS

GAUSSIAN, MULTIPLY, BIAS_GAUSSIAN, BIAS_MULTIPLY, BY_LEVEL, HOLD = (1 << bit for bit in range(6))
"""What a column's flags say; the bits above them are the number of its observation."""
KEY_SHIFT = 6

HAS_BIAS, HAS_WALK, HAS_RESOLUTION, HAS_DROPOUT, HAS_GAUSSIAN = (1 << bit for bit in range(5))
"""What any column of the transform has; the common combinations have loops of their own in the kernel."""

OFFSET, SPREAD, BIAS_OFFSET, BIAS_SPREAD, WALK_STD, RESOLUTION, DROPOUT = range(7)
"""The rows of the table of parameters."""
NUM_PARAMETERS = 7

_MODES = {"forward": 0, "step": 1, "reset": 2}


_ARGUMENTS = arguments_of(
    (int, "n mode features first_row"),
    (wp.uint32, "stream"),
    (wp.uint64, "seed counter enabled level mask table flags clean bias walk last out"),
)
_COLUMNS = r"""
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
"""

_LANES = 32
"""Threads that share a row on the GPU; the CPU has one, which takes the columns in vector instructions."""

_DEVICE = f"""
    #if defined(__CUDA_ARCH__)
        #define LANES {_LANES}
        #define SYNC __syncwarp();
    #else
        #define LANES 1
        #define SYNC
    #endif
"""


_quick = QuickLaunch(_ARGUMENTS, _DEVICE + DRAWS + _COLUMNS)


def _launch(
    clean_EL: Tensor,
    table_PL: Tensor,
    flags_L: Tensor,
    enabled: Tensor,
    level: Tensor,
    seed: Tensor,
    bias_EL: Tensor | None,
    walk_EL: Tensor | None,
    last_EL: Tensor | None,
    features: int,
    moment: str,
    mask_E: Tensor | None,
    stream: int,
    counter: Tensor,
) -> Tensor:
    """Return the noisy readings of E * L clean ones in any shape, drawn at the counts that the counter reaches.

    A "step" adds 1 to the counter of each row [E], and changes what lasts from step to step: `bias_EL`, `walk_EL` and
    `last_EL`, float32, None where no column has it. A "reset" begins the episodes of the masked rows, counts them, and
    returns the others' clean readings. In a "forward", readings are samples, which belong to no episode: the counter []
    stays, and there is no bias, drift or dropout.

    `table_PL` has the rows `OFFSET`, `SPREAD`, ..., float32; `flags_L` tells the kind of noise of each column, int32.
    `enabled` is bool [], `seed` int64 []; `level`, float32 [], is the strength of the columns with `BY_LEVEL`.
    """
    if moment == "forward":
        features &= HAS_GAUSSIAN | HAS_RESOLUTION
    clean_EL = clean_EL.contiguous()
    out_EL = torch.empty_like(clean_EL)
    num_columns = flags_L.numel()
    num_rows = clean_EL.numel() // max(num_columns, 1)
    device = clean_EL.device
    state = seed, counter, enabled, level, mask_E, table_PL, flags_L
    tensors = *state, clean_EL, bias_EL, walk_EL, last_EL, out_EL
    dim = (num_rows, 1 if device.type == "cpu" else _LANES)
    layout = num_columns, _MODES[moment], features, ranks.first_row(num_rows), stream
    _quick(device, dim, *layout, *map(address, tensors))
    return out_EL


add_noise = as_operator(
    "noise",
    _launch,
    lambda clean_EL, *_others: clean_EL.new_empty(clean_EL.shape),
    mutates=("bias_EL", "walk_EL", "last_EL", "counter"),
)
