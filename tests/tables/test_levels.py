"""When a curve has reached its levels, and what several seeds come to."""

from dataclasses import replace

import pytest

from ksim_rl.tables.levels import is_reached, reached, value_of
from ksim_rl.tables.report import figures_of
from ksim_rl.tables.table import Row, Table

LEVELS = {"linear": 1.4, "angular": 1.0}
COMMON = {"task": "go1_velocity_flat", "objective": "ppo", "env_states": 1e6, "seeds": (1, 2, 3)}
SECONDS = Row(**COMMON, measure="seconds", levels=LEVELS, within_s=100.0, most_falls=0.02)
RETURN = Row(**COMMON, published={"PPO": 500.0}, against="PPO")


def curve(*linear):
    return [
        {"env_states": 5e5 * i, "seconds": 10.0 * i, "linear": value, "angular": 1.2}
        for i, value in enumerate(linear)
    ]


def test_a_level_must_hold_in_the_mean_over_a_million_env_states():
    found = reached(curve(0.0, 1.5, 1.0, 1.5, 1.5, 1.5), LEVELS)
    assert found is not None and (found["env_states"], found["seconds"]) == (2.5e6, 50.0)
    assert reached(curve(0.0, 0.0, 1.5, 1.5), LEVELS) is None, "two points span half a million"
    assert reached(curve(1.5, 1.5, 1.5), LEVELS | {"absent": 0.0}) is None


def test_a_point_without_ended_episodes_counts_in_no_mean():
    points = curve(1.5, 1.5, 1.5)
    del points[1]["linear"], points[1]["angular"]
    assert reached(points, LEVELS) is points[2]
    points[2]["linear"] = 1.2
    assert reached(points, LEVELS) is None, "1.35 in the mean of those that are there"


def seeds(*seconds, falls=0.0):
    return [{"seconds_to_levels": value, "falls": falls} for value in seconds]


@pytest.mark.parametrize(
    ("results", "value", "verdict"),
    [
        (seeds(50.0, 90.0, 300.0), 90.0, True),
        (seeds(50.0, 90.0, None), 90.0, True),
        (seeds(50.0, None, None), None, False),
        (seeds(50.0, 110.0, 300.0), 110.0, False),
        (seeds(50.0, 90.0, 95.0, falls=0.02), 90.0, False),
    ],
)
def test_a_seed_that_does_not_get_there_counts_as_infinite(results, value, verdict):
    assert value_of(SECONDS, results) == value
    assert is_reached(SECONDS, results) is verdict


def test_the_seed_with_the_fewest_successes_counts():
    row = Row(**COMMON, measure="success", at_least=0.95)
    results = [{"trials": {"success": value}} for value in (0.99, 0.95, 1.0)]
    assert value_of(row, results) == 0.95 and is_reached(row, results) is True
    assert is_reached(row, [*results, {"trials": {"success": 0.949}}]) is False
    table = Table(name="tracking", title="", rows={"walk": row})
    assert figures_of(table, {"walk": results}) == {"tracking/walk/success": 0.95}


def test_further_figures_have_names_of_their_own():
    row = Row(
        **COMMON,
        measure="success",
        figures={
            "least_trained": "success",
            "mean_held_out": "evaluation/held_out_success",
            "seconds": "seconds",
            "absent": "evaluation/metric/nothing",
        },
    )
    results = []
    for success, held_out, seconds in ((1.0, 0.8, 250.0), (0.96, 0.9, 260.0), (0.98, 0.85, 300.0)):
        means = {"evaluation/held_out_success": held_out}
        results.append({"trials": {"success": success}, "means": means, "seconds": seconds})
    table = Table(name="motions", title="", rows={"track": row})
    assert figures_of(table, {"track": results}) == {
        "motions/track/success": 0.96,
        "motions/track/least_trained": 0.96,
        "motions/track/mean_held_out": 0.8,
        "motions/track/seconds": 260.0,
    }


def test_of_a_course_the_worst_seed_counts_and_its_falls_take_the_place_of_others():
    row = Row(**COMMON, measure="seconds", levels=LEVELS, most_falls=0.05, course_level=7)
    figures = {"course_least": "evaluation/course_least"}
    row = replace(row, within_s=100.0, course_least=0.9, figures=figures)

    def seed(fell, least):
        means = {"evaluation/course_least": least}
        return {"seconds_to_levels": 50.0, "falls": 0.5, "course": {"fell": fell}, "means": means}

    good = seed(0.04, 0.92)
    assert is_reached(row, [good, good]) is True
    table = Table(name="rough", title="", rows={"go1": row})
    worse = seed(0.03, 0.89)
    assert is_reached(row, [good, worse]) is False
    assert is_reached(row, [seed(0.05, 0.95)]) is False
    assert figures_of(table, {"go1": [good, worse]}) == {
        "rough/go1/falls": 0.04,
        "rough/go1/course_least": 0.89,
        "rough/go1/seconds": 50.0,
    }


def test_beside_a_return_each_seed_should_end_with_its_levels():
    row = Row(**COMMON, levels=LEVELS, published={"PPO": 500.0}, against="PPO")
    good = {"evaluation": {"return_mean": 600.0}, "means": {"linear": 1.4, "angular": 1.0}}
    assert is_reached(row, [good, good]) is True
    assert is_reached(row, [good, good | {"means": {"linear": 1.5, "angular": 0.99}}]) is False
    assert is_reached(row, [good, good | {"means": {"linear": 1.5}}]) is False, "no episode ended"
    assert is_reached(row, [good | {"evaluation": {"return_mean": 400.0}}]) is False
    assert is_reached(Row(**COMMON, levels=LEVELS), [good]) is True


def test_returns_are_compared_with_what_one_of_the_others_reports():
    results = [
        {"evaluation": {"return_mean": value}, "falls": 1.0} for value in (400.0, 500.0, 601.0)
    ]
    assert value_of(RETURN, results) == pytest.approx(500.333, abs=1e-3)
    assert is_reached(RETURN, results) is True
    assert is_reached(RETURN, results[:1]) is False
    assert is_reached(Row(**COMMON), results) is None
