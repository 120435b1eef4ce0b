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


def at_borders(num_rows, moves):
    """Return how many rows at a border stay unexplained; in these the recorded step has the other outcome.

    The border is up to one unit away from the input; a move is of several roundings.
    """
    margin = torch.rand(num_rows, generator=torch.Generator().manual_seed(0))

    def moved(number, units):
        moves.append(units)
        draws = torch.Generator().manual_seed(number)
        shift = units * (torch.rand(num_rows, 4, generator=draws) - 0.5).sum(-1)
        return {"x": (shift > margin).float()[:, None]}

    found, true = torch.ones(num_rows, 1), torch.zeros(num_rows, 1)
    return differences({"x": found}, {"x": true}, num_rows=num_rows, moved=moved).get("x", 0)


def test_rows_at_a_border_are_explained_by_larger_moves(monkeypatch):
    moves = []
    few = at_borders(1000, moves)
    assert moves == list(MOVES)
    monkeypatch.setattr("ksim_rl.compiled.differences.MOVES", (1,) * len(MOVES))
    assert at_borders(1000, moves) > 3 * few


def test_one_row_of_two_thousand_may_stay_at_a_border_and_no_move_is_made_for_it():
    true = torch.zeros(4000, 1)
    numbers = []

    def moved(number, units):
        numbers.append(number)
        return {"x": true}

    for rows, expected in ((2, {}), (3, {"x": 3})):
        found = true.clone()
        found[:rows] = 1.0
        numbers.clear()
        assert differences({"x": found}, {"x": true}, num_rows=4000, moved=moved) == expected
        assert len(numbers) == (1 if rows == 2 else len(MOVES))


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
