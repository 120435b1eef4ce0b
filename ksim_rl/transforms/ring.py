"""Keeps the last values of a signal in a ring of slots per env: one kernel, also a torch operator.

A step writes one value per env and reads the values of some steps ago; a reset writes the value that the masked rows
begin with, and no lag reaches back beyond it. Where the ring of an env stands is its age, the steps since its reset,
which the kernel counts on the device, so that a captured step goes on correctly.
"""

import math

import torch
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.device import draws_in_torch as in_torch
from ksim_rl.device.quick_launch import address, as_operator, launch_of

_quick = launch_of("ksim_rl/transforms/ring.cuh")
_LANES = 32
_MANY_LANES = 256
"""Threads that share a row on the GPU: a warp, or a block for large rows."""
NO_DRAWS = None, None, 0, 0, 0
"""The last arguments of `turn`, from `seed` on, where no row draws a lag."""


def _launch(
    ring_EM: Tensor,
    age_E: Tensor,
    value_E: Tensor,
    lag_E: Tensor | None,
    mask_E: Tensor | None,
    num_frames: int,
    stride: int,
    parts: Tensor | None,
    counts: bool,
    seed: Tensor | None,
    draw_count_E: Tensor | None,
    stream: int,
    lowest: int,
    highest: int,
) -> Tensor:
    """Go on by one step: write its values, and return values of some steps ago, N frames of L elements per env.

    The ring has M slots per env. `lag_E` (int64, 0 for None) is the lag of the newest frame, the last one, below M;
    one that reaches back beyond the reset gives the value of that. The age, the steps since each env's reset, is
    changed in place; of several rings with one age only the last one `counts` it on. `parts` are sizes in bytes (int32)
    of the parts of a value: all frames of the first part are returned, then all of the second one, and so on.

    With a mask no step is made: its rows begin with these values, and each row's value is returned N times. With a
    `draw_count_E`, the resets of each row, these rows also draw new lags: `ksim_rl.device.random.integers` at
    the counts that they reach. Lags and counts are changed in place.
    """
    # Columns of a wider tensor stay there: each env's value is contiguous.
    if value_E.ndim > 2 or value_E.ndim == 2 and value_E.stride(1) != 1:
        value_E = value_E.contiguous()
    num_rows, num_slots, *leaf = ring_EM.shape
    device = value_E.device
    item_size = value_E.element_size()
    if len(leaf) == 1:
        size = leaf[0]
    else:
        size = math.prod(leaf)
    out_EL = torch.empty((num_rows, num_frames * size), dtype=value_E.dtype, device=device)
    # Bytes, so that one kernel serves all dtypes.
    num_bytes = size * item_size
    value_stride = value_E.stride(0) * item_size
    value = value_E.data_ptr()
    num_parts = 1 if parts is None else parts.shape[0]
    if device.type == "cpu":
        width = 0
        lanes = 1
    else:
        # The widest words of 16, 4 or 1 bytes that divide sizes and addresses of all rows.
        if parts is None:
            bits = num_bytes | value_stride | value
        else:
            bits = item_size
        if bits % 16 == 0:
            width = 16
        elif bits % 4 == 0:
            width = 4
        else:
            width = 1
        # A warp per row, unless each of its threads would copy more than 32 words per part.
        if num_frames * num_bytes <= 32 * _LANES * width * num_parts:
            lanes = _LANES
        else:
            lanes = _MANY_LANES
    layout = width, lanes, num_bytes, value_stride, num_slots, num_frames, stride, num_parts, counts
    # Draws are keyed by the row among all ranks.
    first_row = ranks.first_row(num_rows)
    draws = first_row, stream, lowest, highest - lowest + 1, address(seed), address(draw_count_E)
    tensors = age_E.data_ptr(), address(lag_E), address(mask_E), address(parts), value
    _quick(
        device, (num_rows, lanes), *layout, *draws, *tensors, ring_EM.data_ptr(), out_EL.data_ptr()
    )
    return out_EL


def _turn_in_torch(
    ring_EM: Tensor,
    age_E: Tensor,
    value_E: Tensor,
    lag_E: Tensor | None,
    mask_E: Tensor | None,
    num_frames: int,
    stride: int,
    parts: Tensor | None,
    counts: bool,
    seed: Tensor | None,
    draw_count_E: Tensor | None,
    stream: int,
    lowest: int,
    highest: int,
) -> Tensor:
    """Do the work of the kernel in torch: see `_launch`."""
    num_rows = ring_EM.shape[0]
    num_slots = ring_EM.shape[1]
    ring_EML = ring_EM.view(num_rows, num_slots, -1)
    value_EL = value_E.reshape(num_rows, -1)
    if mask_E is None:
        # A step: all rows write, at the age that they reach.
        writes_E = torch.ones(num_rows, dtype=torch.bool, device=value_E.device)
        now_E = age_E.reshape(-1) + 1
        if lag_E is None:
            newest_E = torch.zeros_like(now_E)
        else:
            newest_E = lag_E.reshape(-1)
    else:
        # A reset: masked rows begin at age 0, and all frames are the value given.
        writes_E = mask_E.reshape(-1)
        now_E = torch.zeros_like(age_E).reshape(-1)
        newest_E = now_E
        stride = 0
        if seed is not None and draw_count_E is not None and lag_E is not None:
            _draw_lags_in_torch(lag_E, writes_E, seed, draw_count_E, stream, lowest, highest)
    # The slot of the newest value, and how many steps back each frame lies, oldest first.
    slot_E = now_E % num_slots
    age_N = torch.arange(num_frames - 1, -1, -1, device=value_E.device) * stride
    # No frame reaches back beyond the reset.
    lag_EN = torch.minimum(newest_E[:, None] + age_N, now_E[:, None])
    place_EN = (slot_E[:, None] - lag_EN) % num_slots
    # Read before the write: a lag of zero takes the value itself, not the slot.
    kept_ENL = ring_EML.gather(1, place_EN[..., None].expand(-1, -1, value_EL.shape[1]))
    frames_ENL = torch.where(lag_EN[..., None] == 0, value_EL[:, None], kept_ENL)
    # Rows that do not write put back their slot: no size depends on the mask.
    rows_E = torch.arange(num_rows, device=value_E.device)
    ring_EML[rows_E, slot_E] = torch.where(writes_E[:, None], value_EL, ring_EML[rows_E, slot_E])
    if counts:
        age_E.copy_(torch.where(writes_E, now_E, age_E.reshape(-1)).view_as(age_E))
    if parts is None:
        return frames_ENL.reshape(num_rows, -1)
    # Of joined signals, all frames of each one lie together.
    sizes = [size // value_E.element_size() for size in parts.tolist()]
    columns = [part.reshape(num_rows, -1) for part in frames_ENL.split(sizes, dim=2)]
    return torch.cat(columns, dim=1)


def _draw_lags_in_torch(
    lag_E: Tensor,
    begins_E: Tensor,
    seed: Tensor,
    draw_count_E: Tensor,
    stream: int,
    lowest: int,
    highest: int,
) -> None:
    num_rows = len(begins_E)
    # The resets that the rows reach; only masked rows keep theirs.
    count_E = draw_count_E.reshape(-1) + 1
    first_row = ranks.first_row(num_rows)
    keys = in_torch.keys_of(seed, stream, count_E, num_rows=num_rows, first_row=first_row)
    bits_E = in_torch.bits_of(keys, torch.zeros(1, dtype=torch.int64, device=seed.device))[:, 0]
    drawn_E = in_torch.whole(bits_E, lowest, highest - lowest + 1)
    draw_count_E += begins_E.view_as(draw_count_E)
    lag_E.copy_(torch.where(begins_E, drawn_E, lag_E.reshape(-1)).view_as(lag_E))


turn = as_operator(
    "ring",
    _launch,
    lambda ring_EM, _age_E, value_E, _lag_E, _mask_E, num_frames, *_: value_E.new_empty(
        (ring_EM.shape[0], num_frames * ring_EM.shape[2:].numel())
    ),
    mutates=("ring_EM", "age_E", "lag_E", "draw_count_E"),
    in_torch=_turn_in_torch,
)
