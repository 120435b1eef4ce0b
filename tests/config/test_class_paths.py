"""Paths of classes in configs: public ones now, and those that 0.1 wrote."""

import dataclasses
import importlib
import json
from pathlib import Path

import pytest

from ksim_rl import envs
from ksim_rl.config import class_paths
from ksim_rl.envs import ManagerBasedRlEnvCfg, from_tree, to_tree


def targets(tree):
    if isinstance(tree, dict):
        return (
            {tree["_target_"]}
            if set(tree) == {"_target_"}
            else {
                *([tree["_target_"]] if "_target_" in tree else []),
                *(t for v in tree.values() for t in targets(v)),
            }
        )
    return {t for v in tree for t in targets(v)} if isinstance(tree, list) else set()


def test_configs_name_classes_by_public_paths():
    tree = to_tree(envs.task("go1_velocity_flat").cfg(), ManagerBasedRlEnvCfg)
    assert tree["rewards"]["track_linear_velocity"]["_target_"] == "ksim_rl.mdp.TrackLinearVelocity"
    assert {t.rpartition(".")[0] for t in targets(tree)} <= {
        "ksim_rl.mdp", "ksim_rl.transforms", "ksim_rl.scene.robots", "ksim_rl.scene.sensors", "ksim_rl.scene.terrains",
        "ksim_rl.scene.actuators",
    }  # fmt: skip


OLD = (Path(__file__).parent / "targets_of_0_1.txt").read_text().split()
ROUGH = ("go1_velocity_rough",)
RUNS = json.loads((Path(__file__).parent / "runs_of_0_1.json").read_text())


@pytest.mark.parametrize("target", OLD)
def test_each_path_that_0_1_wrote_leads_to_its_class(target):
    found = class_paths.find(target, "x", kind="class", accepts=lambda value: True)
    assert found.__name__ == target.rpartition(".")[2]
    assert (
        class_paths.find(
            class_paths.public_path(found), "x", kind="class", accepts=lambda value: True
        )
        is found
    )


@pytest.mark.parametrize("target", sorted(class_paths.MOVED_CLASSES))
def test_a_class_that_has_left_its_module_is_found_by_its_earlier_path(target):
    """Configs of runs and of checkpoints keep the path with which they were written."""
    found = class_paths.find(target, "x", kind="class", accepts=lambda value: True)
    package = class_paths.MOVED_CLASSES[target]
    name = target.rpartition(".")[2]
    assert class_paths.public_path(found) == f"{package}.{name}"
    # The module is there, and has it no more, so that nothing else finds it.
    assert not hasattr(importlib.import_module(target.rpartition(".")[0]), name)


def test_a_stored_task_that_names_an_earlier_path_builds_the_same_task():
    cfg = envs.task("walker_amp").cfg()
    tree = to_tree(cfg, ManagerBasedRlEnvCfg)
    now = tree["metrics"]["pose_distance"]["_target_"]
    assert now == "ksim_rl.mdp.PoseDistance"
    tree["metrics"]["pose_distance"]["_target_"] = "ksim_rl.tasks.planar.PoseDistance"
    assert from_tree(ManagerBasedRlEnvCfg, tree) == cfg


@pytest.mark.parametrize("name", sorted(RUNS))
def test_a_task_config_that_0_1_wrote_builds_the_same_task(name):
    found = from_tree(ManagerBasedRlEnvCfg, RUNS[name])
    expected = envs.make_cfg(name)
    if name in ROUGH:
        # A foot on rough ground has more contacts than 0.1 found, and today's task has room for them.
        assert found.sim.njmax < expected.sim.njmax
        # Nor did 0.1 read contacts in each substep, or make commands faster by stages.
        scene = dataclasses.replace(found.scene, sensors=expected.scene.sensors)
        found = dataclasses.replace(
            found,
            sim=dataclasses.replace(found.sim, njmax=expected.sim.njmax),
            scene=scene,
            curriculum=expected.curriculum,
        )
    assert found == expected


def test_fields_that_are_gone_are_ignored_and_only_where_they_were():
    tree = RUNS[min(RUNS)]
    assert from_tree(
        ManagerBasedRlEnvCfg, {**tree, "sim": {**tree["sim"], "deterministic": True}}
    ) == from_tree(ManagerBasedRlEnvCfg, tree)
    with pytest.raises(ValueError, match="deterministic"):
        from_tree(ManagerBasedRlEnvCfg, {**tree, "deterministic": True})


@pytest.mark.parametrize(
    ("target", "instead"),
    [
        ("ksim_rl.envs.actuators.GeneralActuator", "a <general> actuator in the robot's MJCF"),
        ("ksim_rl.envs.transforms.RandomCommandCurriculum", "ksim_rl.mdp.CommandRangesByLevel"),
    ],
)
def test_a_class_of_0_1_that_is_gone_is_refused_with_what_to_use(target, instead):
    name = target.rpartition(".")[2]
    with pytest.raises(
        ValueError, match=rf"^a\._target_='{target}': {name} is gone: use {instead}$"
    ):
        class_paths.find(target, "a", kind="dataclass", accepts=dataclasses.is_dataclass)


def test_classes_that_the_command_line_could_not_load_are_noted():
    here, plugged = (
        {"_target_": "__main__.Mine"},
        {"_target_": "some_package.terms.Alive", "weight": 1.0},
    )
    own = {
        "_target_": "ksim_rl.mdp.Alive",
        "inside": [{"_target_": "torchrl.envs.transforms.InitTracker"}],
    }
    in_a_function = {"_target_": "other_package.build.<locals>.Term"}
    rewards = {
        "a": here,
        "b": plugged,
        "c": [plugged, {**plugged, "_target_": "some_package.more.Dead"}],
    }
    notes = class_paths.loading_notes(
        {"task": {"rewards": rewards, "own": own, "f": in_a_function}}
    )
    assert [note.split(":")[0] for note in notes] == [
        "this run names __main__.Mine, which no other process can import",
        "this run names some_package.terms.Alive",
        "this run names other_package.build.<locals>.Term, which no other process can import",
    ]
    assert notes[1].endswith("give `ksim-rl` --plugin some_package")
    assert class_paths.loading_notes(to_tree(envs.task("go1_velocity_flat").cfg())) == []


def test_a_named_plug_in_needs_no_note(monkeypatch):
    monkeypatch.setattr(class_paths.plugins, "_named", ["some_package.tasks"])
    assert class_paths.loading_notes({"_target_": "some_package.terms.Alive"}) == []
