"""What the benchmark of the course says beside it: how a policy was trained, and how its teacher walks."""

import dataclasses

import pytest
import torch

from benchmarks import command_line, terrain_course
from benchmarks.terrain_course import beside_teacher, trained
from ksim_rl import envs
from ksim_rl.runs.csv_table import CsvTable
from ksim_rl.scene.terrains import FlatPatch, TerrainGrid
from ksim_rl.tasks.terrain_course import Outcomes, course_of
from ksim_rl.trainers.run_folder import Policy


def test_the_level_of_training_is_that_of_the_last_million_env_states_of_the_policy(tmp_path):
    assert trained(tmp_path, 3) == {}
    table = CsvTable(tmp_path / "metrics.csv")
    for iteration, level in enumerate((1.0, 2.0, 4.0, 9.0), start=1):
        table.log_metrics(
            {"iteration": iteration, terrain_course.LEVEL: level}, iteration * 600_000
        )
    checkpoint = tmp_path / "checkpoint" / "3"
    for path in (tmp_path, tmp_path / "checkpoint", checkpoint):
        assert trained(path, 3) == {"env_states": 1_800_000, "trained_level": 3.0}
    assert trained(tmp_path, 4)["trained_level"] == 6.5


def test_a_student_is_measured_by_its_teacher_on_the_same_kinds_of_ground(monkeypatch):
    # The teacher gets across everywhere but on the hardest level of "b".
    theirs = Outcomes(
        kind_E=torch.tensor([0, 0, 1, 1]),
        level_E=torch.tensor([0, 1, 0, 1]),
        arrived_E=torch.tensor([True, True, True, False]),
        fell_E=torch.zeros(4, dtype=torch.bool),
        lost_worlds=2,
    )
    grid = TerrainGrid(patches={"a": FlatPatch(), "b": FlatPatch()}, num_levels=2, num_columns=2)
    task = dataclasses.replace(
        course := course_of(envs.task("go1_velocity_rough").cfg()),
        cfg=dataclasses.replace(
            course.cfg, scene=dataclasses.replace(course.cfg.scene, terrain=grid)
        ),
    )
    monkeypatch.setattr(terrain_course, "course_of", lambda _: task)
    monkeypatch.setattr(terrain_course, "walk", lambda *_, **__: theirs)
    run = command_line.compose(["task=cartpole_balance", "device=cpu"])
    teacher = Policy(cfg=run, actor=torch.nn.Identity(), iteration=0)
    ours = {"a": [1.0, 0.5], "b": [0.5, 0.25]}
    # The share is of the mean that the course's own summary gives.
    found = beside_teacher(teacher, ours, success=0.6, num_envs=4)
    assert found == pytest.approx(
        {"teacher_success": 0.75, "share_of_teacher": 0.8, "weakest": 0.25, "lost_worlds": 2}
    )
    with pytest.raises(ValueError, match="take the run from which it learned"):
        beside_teacher(teacher, {"a": [1.0, 0.5]}, success=0.75, num_envs=4)
    theirs.arrived_E.zero_()
    with pytest.raises(ValueError, match="teacher: it arrives nowhere"):
        beside_teacher(teacher, ours, success=0.6, num_envs=4)
