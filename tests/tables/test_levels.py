"""When a curve has reached its levels, and what several seeds come to."""

from contextlib import suppress
from dataclasses import replace

import pytest

from ksim_rl import envs
from ksim_rl.tables.levels import is_reached, less_is_better, lost_worlds_of, reached, value_of
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


ERRORS = {
    "action_acceleration",
    "angular_velocity_error",
    "body_drift",
    "body_pos_error",
    "ee_pos_error",
    "joint_pos_error",
    "linear_velocity_error",
    "mpkpe",
    "pose_distance",
    "r_mpkpe",
}
GOOD = {
    "at_target",
    "forward_speed",
    "goals_reached",
    "is_open",
    "stands",
    "stood_soon",
    "success",
    "target_reached",
}


def test_each_metric_of_the_package_is_known_to_be_an_error_or_none():
    named = set()
    for name in envs.names():
        # Tasks of the suites have metrics of their own packages, and some need models that are not here.
        with suppress(ValueError, ImportError):
            named |= set(envs.task(name).cfg().metrics)
    assert named <= ERRORS | GOOD, "a new metric: is less of it better?"
    for name in ERRORS:
        assert less_is_better(f"evaluation/metric/{name}"), name
    for name in GOOD:
        assert not less_is_better(f"evaluation/metric/{name}"), name


@pytest.mark.parametrize(
    ("name", "is_error"),
    [
        ("termination/fell_over", True),
        ("termination/time_out", False),
        ("reward/action_acceleration", False),
        ("reward/track_linear_velocity", False),
        ("evaluation/course_least", False),
        ("evaluation/held_out_success", False),
        ("episode/return", False),
        ("loss/policy", True),
    ],
)
def test_figures_beside_metrics_are_errors_by_their_names(name, is_error):
    assert less_is_better(name) is is_error


def test_of_an_error_the_worst_seed_is_the_one_with_the_largest():
    error = "evaluation/metric/pose_distance"
    good = "evaluation/metric/success"
    figures = {"distance": error, "success": good}
    row = Row(**COMMON, figures=figures, levels={error: 0.3, good: 0.9})

    def seed(distance, success):
        return {"evaluation": {"return_mean": 1.0}, "means": {error: distance, good: success}}

    table = Table(name="motions", title="", rows={"style": row})
    found = figures_of(table, {"style": [seed(0.1, 0.95), seed(0.25, 0.9)]})
    assert found["motions/style/distance"] == 0.25
    assert found["motions/style/success"] == 0.9
    assert is_reached(row, [seed(0.1, 0.95), seed(0.3, 0.9)]) is True
    assert is_reached(row, [seed(0.1, 0.95), seed(0.31, 0.9)]) is False
    without = {"evaluation": {"return_mean": 1.0}, "means": {good: 1.0}}
    assert is_reached(row, [without]) is False, "no episode ended"


def test_the_level_of_an_error_holds_in_the_mean_where_it_is_small_enough():
    points = curve(1.0, 0.3, 0.5, 0.3, 0.3, 0.3)
    for point in points:
        point["metric/mpkpe"] = point.pop("linear")
    found = reached(points, {"metric/mpkpe": 0.4})
    assert found is not None and found["env_states"] == 1.5e6, "0.3, 0.5 and 0.3"
    assert reached(points, {"metric/mpkpe": 0.2}) is None


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


def test_nothing_is_reached_on_contacts_that_were_lost():
    good = {"evaluation": {"return_mean": 600.0, "lost_worlds": 0}, "trials": None}
    assert is_reached(RETURN, [good, good]) is True
    for lost in (
        {"evaluation": {"return_mean": 600.0, "lost_worlds": 3}},
        {"trials": {"success": 1.0, "lost_worlds": 3}},
        {"course": {"fell": 0.0, "lost": ["rows"], "lost_worlds": 3}},
    ):
        assert is_reached(RETURN, [good, good | lost]) is False
        assert lost_worlds_of([good, good | lost]) == 3
        assert is_reached(Row(**COMMON), [good | lost]) is False, "a row without a goal, too"
    # A course of before has a line for each kind of loss.
    before = good | {"course": {"fell": 0.0, "lost": ["rows", "pool"]}}
    assert is_reached(RETURN, [before]) is False


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
