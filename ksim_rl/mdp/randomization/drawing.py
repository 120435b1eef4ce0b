"""Draws entries of a model field by one kernel, in the worlds of a mask.

At each step a few worlds reset, so that the number of kernels per draw counts. Its numbers are the same as in
`ksim_rl.device.random` at the same coordinates.
"""

from torch import Tensor

from ksim_rl.device.quick_launch import address, as_operator, launch_of

_quick = launch_of("ksim_rl/mdp/randomization/drawing.cuh")


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
    the model's own values, and how much the follower [E, N, F] has of each. The numbers are those that
    drawing.cuh takes first.
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
