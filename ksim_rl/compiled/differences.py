"""Says where what a step gave differs from what it should have given, by more than rounding can explain.

A step has places where rounding decides: whether a contact begins, or a clock has run out. What the smallest change of
what the true step reads and rounds does to a row of its results is therefore what rounding may do there, and no more.
"""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

TOLERANCE = 1e-4
"""Relative error of a number that needs no explanation."""
FLOOR = 1e-6
"""Errors below this share of the largest number in the same column, a few units in its last place, need none either."""
ALLOWANCE = 10.0
"""How many times the change by moved numbers an error may be: these are few samples."""
MOST_MOVES = 16
"""Moves before an error counts as unexplained; most are explained by the first."""

NamedLeaves = Mapping[str, Shaped[Tensor, "*?shape"]]


def differences(
    found: NamedLeaves, true: NamedLeaves, *, num_rows: int, moved: Callable[[int], NamedLeaves]
) -> dict[str, int]:
    """Return the names of what differs, with the number of rows, in the order of `true`.

    `moved(number)` gives the outcome of the true step when each number that it reads or rounds moves by one unit in its
    last place, up or down, in another way for each `number`. Tensors whose first dim is not `num_rows` are one row.
    """
    too_far: dict[str, Tensor] = {}
    for name, values in true.items():
        if values.numel():
            too_far[name] = _rows(_is_too_far(found[name], values), num_rows).any(-1)
    if not too_far:
        return {}
    # One look at the device for all of them: most often there is nothing to see.
    is_open = torch.stack([rows.any() for rows in too_far.values()]).tolist()
    open_rows = {name: rows for (name, rows), is_one in zip(too_far.items(), is_open, strict=True) if is_one}
    errors = {name: _error(found[name], true[name], num_rows) for name in open_rows}
    for number in range(MOST_MOVES):
        if not open_rows:
            break
        other = moved(number)
        for name in list(open_rows):
            spread = _error(other[name], true[name], num_rows)
            open_rows[name] &= errors[name] > ALLOWANCE * spread
            if not bool(open_rows[name].any()):
                del open_rows[name]
    return {name: int(rows.sum()) for name, rows in open_rows.items()}


def _is_too_far(found: Tensor, true: Tensor) -> Tensor:
    same = (found == true) | (found.isnan() & true.isnan())
    if not true.is_floating_point():
        return ~same
    allowed = TOLERANCE * true.abs() + FLOOR * _scale(true)
    # A comparison with NaN is false.
    return ~(same | ((found - true).abs() <= allowed))


def _error(found: Tensor, true: Tensor, num_rows: int) -> Float[Tensor, " rows"]:
    """Return the largest error in each row, as a share of the scale of its column; infinite where only one is NaN."""
    if not true.is_floating_point():
        error = (found != true).float()
    else:
        scale = _scale(true).clamp_min(torch.finfo(true.dtype).tiny)
        error = (found - true).abs() / scale
        same = (found == true) | (found.isnan() & true.isnan())
        error = torch.where(same, 0.0, error.nan_to_num(nan=torch.inf))
    return _rows(error, num_rows).amax(-1)


def _scale(true: Tensor) -> Tensor:
    """Return the largest finite number in each column, of a tensor without rows in all of it."""
    sizes = torch.where(true.isfinite(), true.abs(), 0.0)
    if true.ndim > 1:
        return sizes.amax(0, keepdim=True)
    return sizes.amax()


def _rows(values: Tensor, num_rows: int) -> Tensor:
    has_rows = values.ndim > 0 and values.shape[0] == num_rows
    if has_rows:
        return values.reshape(num_rows, -1)
    return values.reshape(1, -1)
