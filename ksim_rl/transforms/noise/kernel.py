"""Adds noise to all observations of a transform by one kernel, which is also a torch operator.

Each column's draws come from `ksim_rl.device.random` at (seed, stream, counter, row, column).
"""

import torch
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.device import draws_in_torch as draws
from ksim_rl.device.quick_launch import address, as_operator, launch_of

# The bits of a column's flags; the bits above them are the number of its observation.
GAUSSIAN = 1
MULTIPLY = 2
BIAS_GAUSSIAN = 4
BIAS_MULTIPLY = 8
BY_LEVEL = 16
HOLD = 32
KEY_SHIFT = 6

# Features that at least one column of the transform has; common combinations have loops of their own in the kernel.
HAS_BIAS = 1
HAS_WALK = 2
HAS_RESOLUTION = 4
HAS_DROPOUT = 8
HAS_GAUSSIAN = 16

# The rows of the table of parameters.
OFFSET = 0
SPREAD = 1
BIAS_OFFSET = 2
BIAS_SPREAD = 3
WALK_STD = 4
RESOLUTION = 5
DROPOUT = 6
NUM_PARAMETERS = 7

BIAS_INDEX = 0x40000000
WALK_INDEX = 0x80000000
DROPOUT_INDEX = 0xC0000000
"""Where the draws of biases, of drifts and of lost readings begin among a row's draws, as in `noise.cuh`."""

_MODES = {"forward": 0, "step": 1, "reset": 2}


_LANES = 32
"""Threads that share a row on the GPU; the CPU has one, which takes the columns in vector instructions."""

_CONSTANTS = {
    "GPU_LANES": _LANES,
    "HAS_BIAS": HAS_BIAS,
    "HAS_WALK": HAS_WALK,
    "HAS_RESOLUTION": HAS_RESOLUTION,
    "HAS_DROPOUT": HAS_DROPOUT,
    "HAS_GAUSSIAN": HAS_GAUSSIAN,
    "GAUSSIAN": GAUSSIAN,
    "MULTIPLY": MULTIPLY,
    "BIAS_GAUSSIAN": BIAS_GAUSSIAN,
    "BIAS_MULTIPLY": BIAS_MULTIPLY,
    "BY_LEVEL": BY_LEVEL,
    "HOLD": HOLD,
    "KEY_SHIFT": KEY_SHIFT,
    "OFFSET": OFFSET,
    "BIAS_OFFSET": BIAS_OFFSET,
    "WALK_STD": WALK_STD,
    "RESOLUTION": RESOLUTION,
    "DROPOUT": DROPOUT,
}
_quick = launch_of("ksim_rl/transforms/noise/noise.cuh", _CONSTANTS)


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

    A "step" adds 1 to the counter of each row [E], and changes the state between steps: `bias_EL`, `walk_EL` and
    `last_EL`, float32, None where no column has it. A "reset" begins the episodes of the masked rows, counts them, and
    returns the others' clean readings. In a "forward", readings are samples, which belong to no episode: the counter []
    stays, and there is no bias, drift or dropout.

    `table_PL` has the rows `OFFSET`, `SPREAD`, ..., float32; `flags_L` tells the kind of noise of each column, int32.
    `enabled` is bool [], `seed` int64 []; `level`, float32 [], is the strength of the columns with `BY_LEVEL`.
    """
    # Samples belong to no episode, so that only noise without memory applies.
    if moment == "forward":
        features &= HAS_GAUSSIAN | HAS_RESOLUTION
    # The kernel reads rows by address.
    clean_EL = clean_EL.contiguous()
    out_EL = torch.empty_like(clean_EL)
    num_columns = flags_L.numel()
    # At least 1: without columns there are no readings, and no rows.
    num_rows = clean_EL.numel() // max(num_columns, 1)
    device = clean_EL.device
    state = seed, counter, enabled, level, mask_E, table_PL, flags_L
    tensors = *state, clean_EL, bias_EL, walk_EL, last_EL, out_EL
    # A warp per row on the GPU, one thread per row on the CPU.
    dim = (num_rows, 1 if device.type == "cpu" else _LANES)
    layout = num_columns, _MODES[moment], features, ranks.first_row(num_rows), stream
    _quick(device, dim, *layout, *map(address, tensors))
    return out_EL


def _noise_in_torch(
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
    """Do the work of the kernel in torch: see `_launch`."""
    num_columns = flags_L.numel()
    if not clean_EL.numel():
        return torch.empty_like(clean_EL)
    x_EL = clean_EL.reshape(-1, num_columns)
    num_rows = len(x_EL)
    if mask_E is None:
        # At a reset only masked rows are noisy; in a step all are.
        begins_E = torch.ones(num_rows, dtype=torch.bool, device=clean_EL.device)
    else:
        begins_E = mask_E.reshape(-1)
    if moment == "forward":
        count = counter + 1
    else:
        count = counter.reshape(-1) + 1
    keys = draws.keys_of(
        seed, stream, count, num_rows=num_rows, first_row=ranks.first_row(num_rows)
    )
    # Batches of samples are counted by the caller, since one counter serves all rows.
    if moment != "forward":
        counter += begins_E.view_as(counter)
    else:
        features &= HAS_GAUSSIAN | HAS_RESOLUTION
    column_L = torch.arange(num_columns, device=clean_EL.device)
    # where noise is off; the level scales it for the columns that follow one.
    strength_L = enabled.float() * torch.where(flags_L & BY_LEVEL > 0, level, 1.0)

    def keep(state_EL: Tensor | None, new_EL: Tensor) -> None:
        assert state_EL is not None, "what a feature keeps has memory"
        rows_EL = state_EL.view(num_rows, num_columns)
        rows_EL.copy_(torch.where(begins_E[:, None], new_EL, rows_EL))

    def sample(first: int, parameter: int, is_normal_L: Tensor) -> Tensor:
        bits_EL = draws.bits_of(keys, column_L + first)
        drawn_EL = torch.where(is_normal_L, draws.normal(bits_EL), draws.unit(bits_EL))
        return table_PL[parameter] + table_PL[parameter + 1] * drawn_EL

    def applied(x_EL: Tensor, noise_EL: Tensor, multiplies_L: Tensor) -> Tensor:
        # A multiplier fades to 1, an addition to 0.
        scaled_EL = x_EL * (strength_L * noise_EL + (1.0 - strength_L))
        return torch.where(multiplies_L, scaled_EL, x_EL + strength_L * noise_EL)

    if features & HAS_BIAS and bias_EL is not None:
        if moment == "reset":
            keep(bias_EL, sample(BIAS_INDEX, BIAS_OFFSET, flags_L & BIAS_GAUSSIAN > 0))
        x_EL = applied(x_EL, bias_EL.view(num_rows, num_columns), flags_L & BIAS_MULTIPLY > 0)
    if features & HAS_WALK and walk_EL is not None:
        # A random walk begins at zero with each episode.
        drift_EL = torch.zeros_like(x_EL)
        if moment != "reset":
            steps_EL = draws.normal(draws.bits_of(keys, column_L + WALK_INDEX))
            drift_EL = walk_EL.view(num_rows, num_columns) + table_PL[WALK_STD] * steps_EL
        keep(walk_EL, drift_EL)
        x_EL = x_EL + strength_L * drift_EL
    x_EL = applied(x_EL, sample(0, OFFSET, flags_L & GAUSSIAN > 0), flags_L & MULTIPLY > 0)
    # Rounded after all noise, as a sensor of that resolution reports it.
    if features & HAS_RESOLUTION:
        step_L = strength_L * table_PL[RESOLUTION]
        x_EL = torch.where(step_L > 0.0, (x_EL / step_L).round() * step_L, x_EL)
    if features & HAS_DROPOUT and last_EL is not None:
        if moment != "reset":
            # One draw for all columns of an observation.
            chance_EL = draws.unit(
                draws.bits_of(keys, (flags_L >> KEY_SHIFT).long() + DROPOUT_INDEX)
            )
            lost_EL = chance_EL < strength_L * table_PL[DROPOUT]
            held_EL = torch.where(flags_L & HOLD > 0, last_EL.view(num_rows, num_columns), 0.0)
            x_EL = torch.where(lost_EL, held_EL, x_EL)
        keep(last_EL, x_EL)
    # At a reset the other rows keep their clean readings.
    noisy_EL = torch.where(begins_E[:, None], x_EL, clean_EL.reshape(-1, num_columns))
    return noisy_EL.view(clean_EL.shape)


add_noise = as_operator(
    "noise",
    _launch,
    lambda clean_EL, *_others: clean_EL.new_empty(clean_EL.shape),
    mutates=("bias_EL", "walk_EL", "last_EL", "counter"),
    in_torch=_noise_in_torch,
)
