"""Draws entries of a model field by one kernel, in the worlds of a mask.

At each step a few worlds reset, so that the number of kernels per draw counts. Its numbers are the same as in
`ksim_rl.device.random` at the same coordinates.
"""

from torch import Tensor

from ksim_rl.device.quick_launch import ADDRESS, QuickLaunch, address, arguments_of, as_operator
from ksim_rl.device.random import DRAWS

_ARGUMENTS = arguments_of(
    (int, "elements columns shared kind operation"),
    (float, "cut"),
    (int, "lanes world_stride element_stride followers counter_stride first_row"),
    ("uint32", "stream"),
    (ADDRESS, "seed counter mask table field follower"),
)
# A follower is a field that grows in proportion to the only column that is drawn; it has as many elements.
_quick = QuickLaunch(
    _ARGUMENTS,
    DRAWS
    + r"""
    if (a.mask && !((const unsigned char*)a.mask)[row]) return;
    const int elements = a.elements, columns = a.columns, followers = a.followers, is_log = a.kind == 1;
    auto end_of = [=](float end) { return is_log ? wp::log(end) : end; };
    const float *first = (const float*)a.table, *second = first + columns, *places = second + columns;
    const float *ids = places + columns, *own = ids + elements, *ratios = own + elements * columns;
    const long long count = ((const long long*)a.counter)[row * a.counter_stride];
    const RowKey key = key_of(*(const long long*)a.seed, a.stream, count, a.first_row + row);
    for (int item = lane; item < elements * columns; item += a.lanes) {
        const int element = item / columns, column = item - element * columns;
        const unsigned bits = bits_of(key, (unsigned)(a.shared ? column : item));
        const float sample = a.kind == 2 ? wp::clamp(normal(bits), -a.cut, a.cut) : unit(bits);
        const float low = end_of(first[column]), high = end_of(second[column]);
        const float sum = low + (a.kind == 2 ? high : high - low) * sample, drawn = is_log ? wp::exp(sum) : sum;
        const float value = a.operation == 0 ? drawn : a.operation == 1 ? own[item] + drawn : own[item] * drawn;
        const int id = (int)ids[element];
        ((float*)a.field)[(long long)row * a.world_stride + id * a.element_stride + (int)places[column]] = value;
        float* follower = (float*)a.follower + ((long long)row * (a.world_stride / a.element_stride) + id) * followers;
        for (int i = 0; i < followers; ++i) follower[i] = ratios[element * followers + i] * value;
    }
""",
)


def _launch(
    field_ENC: Tensor,
    mask_E: Tensor | None,
    seed: Tensor,
    counter: Tensor,
    table_L: Tensor,
    follower_ENF: Tensor | None,
    numbers: list[int],
    cut: float,
    stream: int,
    first_row: int,
) -> None:
    """Draw entries of a field [E, N, C] in the worlds of `mask_E`, or in all.

    The table has the low and the high ends (means, deviations) and places of the columns, the rows of the elements,
    the model's own values, and how much the follower [E, N, F] has of each. The numbers are the first `_ARGUMENTS`.
    """
    # A warp shares the elements of a world on a GPU; on a CPU one thread does a row.
    lanes = 32 if field_ENC.is_cuda else 1
    # The kernel reads the mask as bytes, one after the other; a null address means all worlds.
    if mask_E is not None:
        mask_E = mask_E.contiguous()
    if follower_ENF is None:
        followers = 0
    else:
        followers = follower_ENF.shape[-1]
    # Strides in elements of the field's first two dims; a counter without dims is shared by all envs (stride
    # 0).
    where = lanes, *field_ENC.stride()[:2], followers, counter.ndim, first_row, stream
    tensors = seed, counter.contiguous(), mask_E, table_L, field_ENC, follower_ENF
    _quick(
        field_ENC.device, (field_ENC.shape[0], lanes), *numbers, cut, *where, *map(address, tensors)
    )


draw_entries = as_operator(
    "draw_entries", _launch, lambda *_: None, mutates=("field_ENC", "follower_ENF")
)
