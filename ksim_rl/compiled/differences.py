"""Names the results of a step that differ from the true ones by more than rounding can explain.

A step has places where rounding decides: whether a contact begins, a clock has run out, or a solver stops an iteration
earlier. The true step is therefore repeated with its inputs and roundings moved by a few units in the last place;
rounding may change a row by as much as that does.
"""

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

TOLERANCE = 1e-4
"""Relative error that is accepted without an explanation."""
FLOOR = 1e-6
"""Errors below this share of the largest number in the same column, a few units in its last place, are accepted too."""
ALLOWANCE = 10.0
"""How many times the change by a move of one unit an error may be; a move of more units counts as so much less."""
SAME_OUTCOME = 0.25
"""A move also explains an error if it leaves at most this share of it: it has led to the outcome that was found."""
MOVES = (1,) * 4 + (8,) * 4
"""Units in the last place of the moves before an error counts as unexplained; most are explained by the first.

The larger ones are for rows with two outcomes, where rounding chooses one. Of n moves of the error's own size all
give the other outcome in one row of n + 1; a larger move crosses over more often.
"""
ROWS_PER_BORDER = 2_000
"""Of so many rows one may stay unexplained: rounding has crossed a border there that no move crosses again.

Of 16,384 worlds of Go1 or G1 up to 3 are left after three moves. Each further move is a step of the env's Python, and
the last row would take forty. A fault of a kernel or a change in Python shows in more rows, or in a batch of fewer.
"""

NamedLeaves = Mapping[str, Shaped[Tensor, "*?shape"]]


def _own(numbers_N: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
    return numbers_N


def differences(
    found: NamedLeaves,
    true: NamedLeaves,
    *,
    num_rows: int,
    moved: Callable[[int, int], NamedLeaves],
    most_of: Callable[[Int[Tensor, " N"]], Int[Tensor, " N"]] = _own,
) -> dict[str, int]:
    """Return the names of the leaves that differ, with the number of rows, in the order of `true`.

    `moved(number, units)` gives the outcome of the true step when each number that it reads or rounds moves by so many
    units in its last place, up or down, in another way for each `number`. Tensors whose first dim is not `num_rows` are
    one row. With several ranks `most_of` returns the largest of their numbers: all ranks make the same moves, since a
    step may wait for the other ranks, and return the same.
    """
    too_far: dict[str, Tensor] = {}
    # First pass on the device: rows [rows] of each leaf that exceed the plain tolerance.
    for name, values in true.items():
        if values.numel():
            too_far[name] = _rows(_is_too_far(found[name], values), num_rows).any(-1)
    if not too_far:
        return {}
    # One look at the device for all of them: most often there is nothing to see.
    counts = _counts(too_far, most_of)
    open_rows = {name: rows for name, rows in too_far.items() if counts[name]}
    # Second pass, only for leaves that failed: can rounding explain the error?
    errors = {}
    for name in open_rows:
        errors[name] = _error(found[name], true[name], _scale(true[name]), num_rows)
    for number, units in enumerate(MOVES):
        if not open_rows:
            break
        # Moves cost a step each, so they stop as soon as every row is explained.
        other = moved(number, units)
        for name, rows in open_rows.items():
            scale = _scale(true[name])
            # A row is explained once a single move changes it by nearly as much, or in the same way.
            change = _error(other[name], true[name], scale, num_rows)
            left = _error(other[name], found[name], scale, num_rows)
            explained = errors[name] <= ALLOWANCE / units * change
            # An infinite error is no share of itself.
            explained |= left < SAME_OUTCOME * errors[name]
            rows.logical_and_(~explained)
        counts = _counts(open_rows, most_of)
        open_rows = {
            name: rows
            for name, rows in open_rows.items()
            if counts[name] > num_rows // ROWS_PER_BORDER
        }
    return {name: counts[name] for name in open_rows}


def _counts(
    rows: Mapping[str, Bool[Tensor, " ?rows"]],
    most_of: Callable[[Int[Tensor, " N"]], Int[Tensor, " N"]],
) -> dict[str, int]:
    """Return how many rows of each leaf are marked, on the rank where most are."""
    counts_N = torch.stack([marked.sum() for marked in rows.values()])
    return dict(zip(rows, most_of(counts_N).tolist(), strict=True))


def equal(found: NamedLeaves, true: NamedLeaves) -> bool:
    """Whether all leaves are equal to the last bit; NaN equals NaN."""
    assert found.keys() == true.keys()
    return all(bool(_is_same(found[name], values).all()) for name, values in true.items())


def _is_same(found: Tensor, true: Tensor) -> Tensor:
    return (found == true) | (found.isnan() & true.isnan())


def _is_too_far(found: Tensor, true: Tensor) -> Tensor:
    same = _is_same(found, true)
    if not true.is_floating_point():
        return ~same
    # The floor keeps a number near zero in a column of large ones from a hopeless relative bound.
    allowed = TOLERANCE * true.abs() + FLOOR * _scale(true)
    # A comparison with NaN is false.
    return ~(same | ((found - true).abs() <= allowed))


def _error(found: Tensor, true: Tensor, scale: Tensor, num_rows: int) -> Float[Tensor, " rows"]:
    """Return the largest error in each row, as a share of the `scale` of its column; infinite where only one is NaN."""
    if not true.is_floating_point():
        error = (found != true).float()
    else:
        # A column of zeros must not divide by zero.
        error = (found - true).abs() / scale.clamp_min(torch.finfo(true.dtype).tiny)
        # Equal infinities and NaN in the same place count as equal.
        error = torch.where(_is_same(found, true), 0.0, error.nan_to_num(nan=torch.inf))
    return _rows(error, num_rows).amax(-1)


def _scale(true: Tensor) -> Tensor:
    """Return the largest finite number in each column, of a tensor without rows in all of it."""
    if not true.is_floating_point():
        return torch.ones((), device=true.device)
    sizes = torch.where(true.isfinite(), true.abs(), 0.0)
    if true.ndim > 1:
        return sizes.amax(0, keepdim=True)
    return sizes.amax()


def _rows(values: Tensor, num_rows: int) -> Tensor:
    has_rows = values.ndim > 0 and values.shape[0] == num_rows
    if has_rows:
        return values.reshape(num_rows, -1)
    return values.reshape(1, -1)
