"""Metrics reduced over the episode, against numbers worked out by hand."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from ksim_rl.envs import EnvView
from ksim_rl.envs.term import MetricTerm
from tests.envs.probe_env import DT, Launch, Speed, puck_env_in_c

REDUCTIONS = ("mean", "last", "max", "sum")


@dataclass(frozen=True, kw_only=True)
class Wave(MetricTerm):
    """-1, -4, -2, -3 in the first four steps of an episode, times the env's number from 1."""

    def __call__(self, view: EnvView) -> Tensor:
        values = torch.tensor([0.0, -1.0, -4.0, -2.0, -3.0])
        return values[view.episode_step_E.clamp(max=4)] * torch.arange(1.0, view.num_envs + 1)


@dataclass(frozen=True, kw_only=True)
class Column(MetricTerm):
    """Returns [E, 1] instead of [E]."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.joint_pos_EL


def finished(env, steps):
    """Run some steps, and return the episode log."""
    root_E = env.reset()
    for _ in range(steps):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(env.num_envs, 1)))
    return env.episode_log()


@pytest.mark.parametrize(
    ("reduce", "value"), [("mean", -2.5), ("last", -3.0), ("max", -1.0), ("sum", -10.0)]
)
def test_each_reduction_over_whole_episodes(reduce, value):
    env = puck_env_in_c(limit=None, episode_length_s=4 * DT, metrics={"wave": Wave(reduce=reduce)})
    # Two episodes of four steps in each of three envs, and three steps that are not over.
    log = finished(env, 11)
    torch.testing.assert_close(log["metric/wave"], torch.tensor(2 * value * (1 + 2 + 3)))
    assert log["episodes"] == 6


def test_reductions_stand_side_by_side_and_episodes_of_other_lengths_do_not_mix():
    # Env e moves 0.02 (e + 1) m a step, and its episode ends beyond 0.05 m: after 3, 2 and 1 steps.
    metrics = {reduce: Wave(reduce=reduce) for reduce in REDUCTIONS}
    env = puck_env_in_c(limit=0.05, metrics=metrics)
    log = finished(env, 1)
    assert {name: float(log[f"metric/{name}"]) for name in REDUCTIONS} == {
        "mean": -3.0, "last": -3.0, "max": -3.0, "sum": -3.0,
    }  # fmt: skip
    log = finished(puck_env_in_c(limit=0.05, metrics=metrics), 3)
    # Env 2 has ended three times with -3; env 1 once with -2, -8; env 0 once with -1, -4, -2.
    expected = {
        "mean": -9.0 - 5.0 - 7.0 / 3.0,
        "last": -9.0 - 8.0 - 2.0,
        "max": -9.0 - 2.0 - 1.0,
        "sum": -9.0 - 10.0 - 7.0,
    }
    for name, value in expected.items():
        assert float(log[f"metric/{name}"]) == pytest.approx(value), name


def test_a_failed_world_adds_nothing():
    env = puck_env_in_c(
        num_envs=1, limit=None, events={"launch": Launch()}, metrics={"speed": Speed(reduce="sum")}
    )
    root_E = env.reset()
    for _ in range(2):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(1, 1)))
    env.world.qvel_EL.fill_(torch.inf)
    env.step_and_maybe_reset(root_E.set("action", torch.zeros(1, 1)))
    log = env.episode_log()
    assert (
        log["termination/non_finite"] == 1 and log["metric/speed"] == 2.0 and log["length_sum"] == 3
    )


def test_the_log_sums_over_rows_that_end_together_and_apart():
    env = puck_env_in_c(limit=0.11, episode_length_s=5 * DT)
    log = finished(env, 5)
    # 0.02 m a step: time-out in step 5; 0.04: beyond in step 3; 0.06: beyond in steps 2 and 4.
    assert (log["termination/time_out"], log["termination/beyond"]) == (1, 3)
    assert log["episodes"] == 4 and log["length_sum"] == 5 + 3 + 2 + 2


def test_a_shape_other_than_one_per_env_is_refused_at_construction():
    with pytest.raises(
        ValueError,
        match=r"'column' returns torch\.float32 \(3, 1\): expected any real dtype \(3,\), one value",
    ):
        puck_env_in_c(metrics={"column": Column()})


def test_an_unknown_reduction_is_refused():
    with pytest.raises(ValueError, match="reduce='median'"):
        Speed(reduce="median")  # pyright: ignore[reportArgumentType]


@dataclass(frozen=True, kw_only=True)
class SquaredPlace(MetricTerm):
    """x^2 of the puck."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.joint_pos_EL[:, 0].square()


@dataclass(frozen=True, kw_only=True)
class BodyPlace(MetricTerm):
    """x of the puck's body, which is derived from the joint."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.body("puck").pos_EL[:, 0]


def test_a_metric_of_substeps_is_their_mean():
    metrics = {
        "step": SquaredPlace(reduce="last"),
        "substep": SquaredPlace(reduce="last", per_substep=True),
        "peak": SquaredPlace(reduce="max", per_substep=True),
    }
    env = puck_env_in_c(limit=None, episode_length_s=2 * DT, metrics=metrics)
    log = finished(env, 2)
    # Env e is at 0.005 (e + 1) k m after k substeps; the second step has the substeps 5 to 8.
    factor = 0.005**2 * (1 + 4 + 9)
    torch.testing.assert_close(log["metric/step"], torch.tensor(factor * 8**2))
    torch.testing.assert_close(
        log["metric/substep"], torch.tensor(factor * (25 + 36 + 49 + 64) / 4)
    )
    torch.testing.assert_close(log["metric/peak"], log["metric/substep"])
    # And so again in the next episode.
    env.episode_log_reset_()
    again = finished(env, 2)
    torch.testing.assert_close(again["metric/substep"], log["metric/substep"])


def test_a_metric_of_substeps_cannot_read_what_has_to_be_derived():
    with pytest.raises(RuntimeError, match=r"metrics/body.*derived quantity"):
        puck_env_in_c(limit=None, metrics={"body": BodyPlace(per_substep=True)})
