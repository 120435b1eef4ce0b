"""Adds noise to all observations of a transform by one kernel, which is also a torch operator.

Each column's draws are those of `ksim_rl.device.random` at (seed, stream, counter, row, column).
"""

import torch
import warp as wp
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.device.quick_launch import QuickLaunch, address, arguments_of, as_operator, source_of
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


_quick = QuickLaunch(_ARGUMENTS, _DEVICE + DRAWS + source_of("ksim_rl.transforms.noise", "noise"))


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
