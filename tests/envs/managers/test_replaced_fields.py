"""A field that a curriculum replaces cannot be overridden in silence."""

from pathlib import Path

import pytest

from ksim_rl import conf, envs
from ksim_rl.cli.main import main
from ksim_rl.config.overrides import given_fields
from ksim_rl.envs import mdp
from ksim_rl.envs.managers.replaced_fields import (
    check_not_replaced,
    check_one_writer,
    overridden_curricula,
)
from ksim_rl.viewer.played import find
from tests.envs.probe_env import puck_cfg

TASK = "go1_velocity_flat"
RANGE = "task.commands.twist.lin_vel_x=[0.0,0.5]"
STAGE = "task.curriculum.command_ranges.stages.120000.lin_vel_x=[0.0,0.6]"
CURRICULA = {
    "ranges": mdp.CommandRangesByStage(command="twist", stages={9: {"lin_vel_x": (0.0, 1.0)}}),
    "level": mdp.CommandRangesByLevel(
        command="gait", start={"height": (0.0, 0.1)}, end={"height": (0.0, 0.2)}
    ),
    "weight": mdp.RewardWeightByStage(reward="upright", stages={9: 2.0}),
    "slope": mdp.RewardWeightByLevel(reward="still", start=0.0, end=1.0),
    "width": mdp.RewardFieldsByStage(reward="upright", stages={9: {"std": 0.1}}),
    "limit": mdp.TerminationFieldsByStage(termination="fell", stages={9: {"limit_angle": 1.0}}),
}


@pytest.mark.parametrize(
    ("override", "curriculum"),
    [
        ("task.commands.twist.lin_vel_x=[0,1]", "ranges"),
        ("task.commands.twist={lin_vel_x: [0, 1], lin_vel_y: [0, 1]}", "ranges"),
        ("task.commands.twist.lin_vel_x.1=0.5", "ranges"),
        ("task.commands.gait.height=[0,1]", "level"),
        ("task.rewards.upright.weight=1.0", "weight"),
        ("task.rewards.still.weight=1.0", "slope"),
        ("task.rewards.upright.std=0.5", "width"),
        ("task.terminations.fell.limit_angle=0.5", "limit"),
    ],
)
def test_each_curriculum_names_what_it_replaces(override, curriculum):
    field = override.partition("=")[0]
    with pytest.raises(
        ValueError, match=rf"{field}.*'{curriculum}'.*~task.curriculum.{curriculum},"
    ):
        check_not_replaced(CURRICULA, [override])


@pytest.mark.parametrize(
    "overrides",
    [
        ["task.commands.twist={lin_vel_y: [0, 1]}", "task.commands.twist.heading=null"],
        ["task.rewards.upright.offset=1.0", "~task.rewards.still"],
        ["task.rewards.upright.weight=1.0", "task.curriculum.weight.stages={9: 1.0}"],
    ],
)
def test_other_fields_and_those_whose_curriculum_is_overridden_too_are_free(overrides):
    curricula = {name: CURRICULA[name] for name in ("ranges", "weight", "width")}
    check_not_replaced(curricula, overrides)


def test_who_overrides_another_field_of_a_curriculum_does_not_know_of_this_one():
    stages = {9: {"lin_vel_x": (0.0, 1.0), "ang_vel_z": (0.0, 1.0)}}
    curricula = {"ranges": mdp.CommandRangesByStage(command="twist", stages=stages)}
    of_z = "task.curriculum.ranges.stages.9.ang_vel_z=[0,2]"
    check_not_replaced(curricula, ["task.commands.twist.ang_vel_z=[0,1]", of_z])
    with pytest.raises(ValueError, match="lin_vel_x: the curriculum 'ranges' replaces"):
        check_not_replaced(curricula, ["task.commands.twist.lin_vel_x=[0,1]", of_z])


def test_a_run_that_goes_on_knows_of_the_curricula_that_it_was_given():
    own = CURRICULA["ranges"]
    wider = mdp.CommandRangesByStage(command="twist", stages={9: {"lin_vel_x": (0.0, 2.0)}})
    assert overridden_curricula({"ranges": own}, {"ranges": own}) == []
    given = overridden_curricula({"ranges": wider}, {"ranges": own})
    assert given == ["task.curriculum.ranges.stages.9.lin_vel_x"]
    check_not_replaced({"ranges": wider}, ["task.commands.twist.lin_vel_x=[0,1]"], given)
    assert overridden_curricula({"ranges": own}, {}) == ["task.curriculum.ranges"]


@pytest.mark.parametrize(
    ("first", "second", "field"),
    [
        ("weight", mdp.RewardWeightByLevel(reward="upright", start=0.0, end=1.0), "upright.weight"),
        ("ranges", mdp.CommandRangesByLevel(
            command="twist", start={"lin_vel_x": (0.0, 0.1)}, end={"lin_vel_x": (0.0, 0.2)}
        ), "twist.lin_vel_x"),
        # Other fields, but of one reward, whose stages are whole terms.
        ("width", mdp.RewardFieldsByStage(reward="upright", stages={7: {"offset": 1.0}}), "rewards.upright"),
    ],
)  # fmt: skip
def test_two_curricula_that_write_one_field_are_refused(first, second, field):
    curricula = {first: CURRICULA[first], "another": second}
    with pytest.raises(ValueError, match=f"'{first}' and 'another' both write .*{field}: join"):
        puck_cfg(curriculum=curricula)


def test_a_weight_and_the_stages_of_other_fields_go_together():
    check_one_writer(CURRICULA)


def test_fields_are_given_down_into_mappings():
    texts = ["a.b=1", "+c={d: 1, e: {f: 2, g: {}}}", "~h", "i=1,2"]
    assert given_fields(texts) == ["a.b", "c.d", "c.e.f", "c.e.g", "i"]


@pytest.mark.full
def test_a_training_is_refused_and_an_evaluation_is_not():
    with pytest.raises(ValueError, match="lin_vel_x: the curriculum 'command_ranges' replaces"):
        envs.make_cfg(TASK, [RANGE])
    cfg = envs.make_cfg(TASK, [RANGE, "~task.curriculum.command_ranges"])
    assert cfg.commands["twist"].ranges["lin_vel_x"] == (0.0, 0.5) and not cfg.curriculum
    with pytest.raises(ValueError, match="'command_ranges' replaces"):
        conf.compose([f"task={TASK}", RANGE])
    # Agents that do not learn.
    shown = conf.compose([f"task={TASK}", RANGE], learns=False)
    assert shown.task.commands["twist"].ranges["lin_vel_x"] == (0.0, 0.5)
    found = find([f"task={TASK}", RANGE], agent="zero", device="cpu")
    assert found.cfg.task == shown.task
    whole = conf.compose([f"task={TASK}", RANGE, STAGE])
    assert whole.task.commands["twist"].ranges["lin_vel_x"] == (0.0, 0.5)
    tree = whole.to_tree()
    # Evaluations leave curricula out.
    assert conf.changed(tree, Path("config.yaml"), [RANGE]).task == whole.task
    # The run was given stages of its own: they need not be named once more where it goes on.
    slower = "task.commands.twist.lin_vel_x=[0.0,0.3]"
    resumed = conf.changed(tree, Path("config.yaml"), [slower], learns=True).task
    assert resumed.commands["twist"].ranges["lin_vel_x"] == (0.0, 0.3)
    assert resumed.curriculum == whole.task.curriculum
    # Stages of another field are no word about this one, nor are the task's own.
    turn = "task.curriculum.command_ranges.stages.120000.ang_vel_z=[0.0,0.6]"
    for given in ([], [turn]):
        tree = conf.compose([f"task={TASK}", *given]).to_tree()
        with pytest.raises(ValueError, match="'command_ranges' replaces"):
            conf.changed(tree, Path("config.yaml"), [RANGE], learns=True)


@pytest.mark.full
def test_overrides_of_a_config_of_the_users_own_are_refused_too(tmp_path, capsys):
    stages = "{_target_: ksim_rl.mdp.RewardWeightByStage, reward: balance, stages: {9: 2.0}}"
    (tmp_path / "mine.yaml").write_text(
        "defaults: [train, {override task: cartpole_balance}, _self_]\n"
        f"task: {{curriculum: {{weight: {stages}}}}}\n"
    )
    own = ("--config-dir", str(tmp_path), "--config-name", "mine")
    folder = f"hydra.run.dir={tmp_path / 'run'}"
    with pytest.raises(SystemExit, match="2"):
        main(["train", *own, folder, "task.rewards.balance.weight=3.0"])
    assert "balance.weight: the curriculum 'weight' replaces" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
