"""Names the results of a step that differ from the true ones by more than rounding can explain.

A step has places where rounding decides: whether a contact begins, or a clock has run out. The true step is therefore
repeated with its inputs and roundings moved by the smallest amount; rounding may change a row by as much as that does.
"""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

TOLERANCE = 1e-4
"""Relative error that is accepted without an explanation."""
FLOOR = 1e-6
"""Errors below this share of the largest number in the same column, a few units in its last place, are accepted too."""
ALLOWANCE = 10.0
"""How many times the change by moved numbers an error may be: these are few samples."""
MOST_MOVES = 16
"""Moves before an error counts as unexplained; most are explained by the first."""

NamedLeaves = Mapping[str, Shaped[Tensor, "*?shape"]]


def differences(
    found: NamedLeaves, true: NamedLeaves, *, num_rows: int, moved: Callable[[int], NamedLeaves]
) -> dict[str, int]:
    """Return the names of the leaves that differ, with the number of rows, in the order of `true`.

    `moved(number)` gives the outcome of the true step when each number that it reads or rounds moves by one unit in its
    last place, up or down, in another way for each `number`. Tensors whose first dim is not `num_rows` are one row.
    """
    too_far: dict[str, Tensor] = {}
    # First pass on the device: rows [rows] of each leaf that exceed the plain tolerance.
    for name, values in true.items():
        if values.numel():
            too_far[name] = _rows(_is_too_far(found[name], values), num_rows).any(-1)
    if not too_far:
        return {}
    # One look at the device for all of them: most often there is nothing to see.
    is_open = torch.stack([rows.any() for rows in too_far.values()]).tolist()
    open_rows = {
        name: rows for (name, rows), is_one in zip(too_far.items(), is_open, strict=True) if is_one
    }
    # Second pass, only for leaves that failed: can rounding explain the error?
    errors = {name: _error(found[name], true[name], num_rows) for name in open_rows}
    for number in range(MOST_MOVES):
        if not open_rows:
            break
        # Moves cost a step each, so they stop as soon as every row is explained.
        other = moved(number)
        for name in list(open_rows):
            spread = _error(other[name], true[name], num_rows)
            # A row is explained once a single move changes it by nearly as much.
            open_rows[name] &= errors[name] > ALLOWANCE * spread
            if not bool(open_rows[name].any()):
                del open_rows[name]
    return {name: int(rows.sum()) for name, rows in open_rows.items()}


def _is_too_far(found: Tensor, true: Tensor) -> Tensor:
    same = (found == true) | (found.isnan() & true.isnan())
    if not true.is_floating_point():
        return ~same
    # The floor keeps a number near zero in a column of large ones from a hopeless relative bound.
    allowed = TOLERANCE * true.abs() + FLOOR * _scale(true)
    # A comparison with NaN is false.
    return ~(same | ((found - true).abs() <= allowed))


def _error(found: Tensor, true: Tensor, num_rows: int) -> Float[Tensor, " rows"]:
    """Return the largest error in each row, as a share of the scale of its column; infinite where only one is NaN."""
    if not true.is_floating_point():
        error = (found != true).float()
    else:
        # A column of zeros must not divide by zero.
        scale = _scale(true).clamp_min(torch.finfo(true.dtype).tiny)
        error = (found - true).abs() / scale
        # Equal infinities and NaN in the same place count as equal.
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
