"""Registered tasks and robot files are judged as generated models are."""

from pathlib import Path

import mujoco
import pytest

from benchmarks.judge import registered
from benchmarks.judge.registered import Registered, figures, judged, robot_files, tasks_of_models

ROBOT = str(registered.OWN_ROBOTS / "pendulum.xml")


def test_tasks_that_share_a_model_are_one(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    names, not_here = tasks_of_models(["walker_walk", "walker_run", "pendulum_swingup"])
    assert names == ["walker_walk", "pendulum_swingup"]
    assert not_here == []


def test_all_robots_of_the_package_are_judged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    own = {path.stem for path in registered.OWN_ROBOTS.glob("*.xml")}
    assert {Path(path).stem for path in robot_files()} == own
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "scene.xml").write_text("<mujoco/>")
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    assert str(tmp_path / "robot" / "scene.xml") in robot_files()


def test_a_task_and_a_robot_are_as_in_c():
    outcomes = {
        "pendulum_swingup": judged(Registered(name="pendulum_swingup", is_task=True)),
        ROBOT: judged(Registered(name=ROBOT, is_task=False)),
    }
    found = figures(outcomes)
    assert found["models"] == 2
    assert found["states"] == 40
    assert found["worse"] == 0


def test_a_task_whose_worlds_have_other_fields_than_c_fails(monkeypatch: pytest.MonkeyPatch):
    def weaken_gravity(mj_model: mujoco.MjModel, values: object) -> None:
        mj_model.opt.gravity[:] = (0.0, 0.0, -5.0)

    monkeypatch.setattr(registered, "write_fields", weaken_gravity)
    outcome = judged(Registered(name="pendulum_swingup", is_task=True))
    assert outcome.fails
    assert "qpos" in {finding.quantity for finding in outcome.verdict.findings}


def test_what_raises_is_worse():
    outcome = judged(Registered(name="no_such_task", is_task=True))
    assert "no_such_task" in outcome.error
    assert figures({"no_such_task": outcome})["worse"] == 1
