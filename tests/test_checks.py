"""Numbers are compared as they are, and errors say of what they are."""

import pytest

from ksim_rl.checks import check_count, check_in_range, check_known, naming


def test_bounds_of_large_ints_are_exact():
    check_in_range("seed", 2**63 - 1, low=0, high=2**63 - 1)
    with pytest.raises(
        ValueError, match=r"seed=9223372036854775808: .* in \[0, 9223372036854775807\]"
    ):
        check_in_range("seed", 2**63, low=0, high=2**63 - 1)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), True, "1", None])
def test_what_is_no_finite_number_is_refused(value):
    with pytest.raises(ValueError, match="rate="):
        check_in_range("rate", value)


def test_an_open_bound_is_outside():
    check_in_range("rate", 0.0, low=0.0)
    with pytest.raises(ValueError, match=r"rate=0\.0: expected a finite number in \(0\.0, 1\.0\]"):
        check_in_range("rate", 0.0, low=0.0, high=1.0, low_open=True)


@pytest.mark.parametrize("value", [0, -1, 2.0, True, "3", None, float("nan")])
def test_what_is_no_count_is_refused(value):
    with pytest.raises(ValueError, match=r"num_envs=.*: expected a whole number >= 1"):
        check_count("num_envs", value)


def test_a_count_may_start_at_zero():
    check_count("burn_in", 0, low=0)
    with pytest.raises(ValueError, match=r"burn_in=-1: expected a whole number >= 0"):
        check_count("burn_in", -1, low=0)


def test_an_unknown_name_is_refused_with_the_near_ones():
    check_known("body", "arm", {"arm": 1})
    with pytest.raises(ValueError, match=r"unknown body 'amr': did you mean 'arm'\?"):
        check_known("body", "amr", {"arm": 1})


def test_errors_are_named_by_what_they_are_of():
    with (
        pytest.raises(ValueError, match=r"^scene.robots.go1: no file$"),
        naming("scene.robots.go1"),
    ):
        raise ValueError("no file")
    with pytest.raises(ValueError, match=r"^go1: no file$"), naming("go1", OSError):
        raise OSError("no file")
    with pytest.raises(ValueError, match=r"^too large$"), naming("go1", OSError):
        raise ValueError("too large")
    with pytest.raises(OSError, match=r"^no file$"), naming("go1"):
        raise OSError("no file")
