"""A difference beyond rounding is found in a single row; one that rounding explains there is none."""

import pytest
import torch

from ksim_rl.compiled.differences import MOVES, TOLERANCE, differences, equal

ROWS = 1000


def found_in(found, true, moved=None):
    """Return what differs, where inputs that have moved change nothing unless `moved` says so."""
    return differences(
        {"x": found},
        {"x": true},
        num_rows=ROWS,
        moved=lambda *_: {"x": true if moved is None else moved},
    )


def values():
    return torch.linspace(0.5, 1.5, ROWS)[:, None].repeat(1, 3)


def with_row(x, row, column, value):
    x = x.clone()
    x[row, column] = value
    return x


def test_a_thousandth_of_the_rows_is_not_too_few():
    true = values()
    assert found_in(true.clone(), true) == {}
    assert found_in(with_row(true, 7, 1, float(true[7, 1]) * (1.0 + 2e-4)), true) == {"x": 1}
    assert found_in(with_row(true, 7, 1, float(true[7, 1]) * (1.0 + 5e-5)), true) == {}


def test_what_moved_inputs_do_to_a_row_explains_an_error_in_this_row_alone():
    true = values()
    found = with_row(with_row(true, 7, 1, 2.0), 8, 1, 2.0)
    assert found_in(found, true, with_row(true, 7, 1, 2.0)) == {"x": 1}
    assert found_in(found, true, with_row(with_row(true, 7, 1, 2.0), 8, 1, 2.0)) == {}
    assert found_in(
        found, true, with_row(with_row(true, 7, 1, 2.0), 8, 1, float(true[8, 1]) + 1e-3)
    ) == {"x": 1}


def test_each_move_is_another_one():
    true, numbers = values(), []

    def moved(number, units):
        numbers.append(number)
        return {"x": with_row(true, 7, 0, 2.0) if number == 3 else true}

    assert (
        differences({"x": with_row(true, 7, 0, 2.0)}, {"x": true}, num_rows=ROWS, moved=moved) == {}
    )
    assert numbers == [0, 1, 2, 3]


def test_a_row_that_stands_at_a_border_is_explained():
    """Contacts that begin, and solvers that stop: two outcomes, and rounding crosses from one to the other."""
    # The last places of each row's input, as multiples of a unit; the recorded step rounds by one unit more.
    generator = torch.Generator().manual_seed(0)
    margin = torch.rand(ROWS, generator=generator)
    true, found = torch.zeros(ROWS, 1), torch.ones(ROWS, 1)

    def moved(number, units):
        draws = torch.Generator().manual_seed(number)
        # Several roundings of so many units each.
        shift = units * (torch.rand(ROWS, 4, generator=draws) - 0.5).sum(-1)
        return {"x": (shift > margin).float()[:, None]}

    assert differences({"x": found}, {"x": true}, num_rows=ROWS, moved=moved) == {}
    # Moves of one unit leave many unexplained.
    small = differences(
        {"x": found}, {"x": true}, num_rows=ROWS, moved=lambda number, _: moved(number, 1)
    )
    assert small["x"] > 10


@pytest.mark.parametrize("wrong", [5.0, float("nan"), 1e30])
def test_a_large_move_explains_no_other_outcome(wrong):
    true = torch.zeros(ROWS, 1)
    crossed = torch.ones(ROWS, 1)

    def moved(number, units):
        return {"x": crossed if units > 1 else true}

    found = with_row(crossed, 7, 0, wrong)
    assert differences({"x": found}, {"x": true}, num_rows=ROWS, moved=moved) == {"x": 1}


def test_moves_stay_below_the_tolerance():
    assert max(MOVES) * torch.finfo(torch.float32).eps < TOLERANCE / 10


def test_equal_leaves_are_equal_to_the_last_bit():
    true = with_row(values(), 7, 0, float("nan"))
    assert equal({"x": true.clone()}, {"x": true})
    assert not equal({"x": torch.nextafter(true, torch.tensor(2.0))}, {"x": true})


@pytest.mark.parametrize(
    ("own", "is_same"),
    [(float("nan"), False), (float("inf"), False), (1.0, True)],
)
def test_numbers_that_are_not_finite_differ_from_those_that_are(own, is_same):
    true = with_row(values(), 7, 0, 1.0)
    assert (found_in(with_row(true, 7, 0, own), true) == {}) == is_same
    both = with_row(values(), 7, 0, own)
    assert found_in(both.clone(), both) == {}


def test_flags_and_whole_numbers_are_equal_or_not():
    true = torch.zeros(ROWS, dtype=torch.bool)
    found = true.clone()
    found[3] = True
    assert found_in(found, true) == {"x": 1}
    assert found_in(found, true, found) == {}
    assert found_in(torch.tensor([5, 7]), torch.tensor([5, 6])) == {"x": 1}


def test_the_last_places_of_a_column_are_no_difference_of_its_small_numbers():
    true = with_row(values(), 7, 0, 0.0)
    assert found_in(with_row(true, 7, 0, 2e-7), true) == {}
    assert found_in(with_row(true, 7, 0, 2e-5), true) == {"x": 1}
    # Of its own column, whatever others hold.
    true[:, 0] *= 1e-4
    assert found_in(with_row(true, 7, 0, 2e-7), true) == {"x": 1}


def test_a_tensor_without_rows_is_one_row_and_an_empty_one_is_none():
    assert found_in(torch.tensor(1.1), torch.tensor(1.0)) == {"x": 1}
    assert found_in(torch.zeros(ROWS, 0), torch.zeros(ROWS, 0)) == {}
