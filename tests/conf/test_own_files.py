"""What a user's own config files say is kept, or refused by the file's name."""

import pytest

from ksim_rl import conf
from ksim_rl.cli.main import main
from ksim_rl.conf.own_files import OwnFile

PRIMARY = "defaults: [train, {override task: quadruped_velocity_flat}, _self_]\n"
RANGE = "task: {commands: {twist: {lin_vel_x: [0.0, 0.5]}}}\n"
REPLACED = "the curriculum 'command_ranges' replaces task.commands.twist.lin_vel_x in training"


@pytest.fixture
def refusal(tmp_path, capsys, monkeypatch):
    """Return the error of a training with a file of the user's own, of that text, by its path in the folder."""
    monkeypatch.chdir(tmp_path)

    def of(path, text, *options):
        file = tmp_path / "configs" / path
        file.parent.mkdir(parents=True)
        file.write_text(text)
        folder = ("--config-dir", str(file.parents[len(file.relative_to(tmp_path).parts) - 2]))
        with pytest.raises(SystemExit, match="2"):
            main(["train", *folder, f"hydra.run.dir={tmp_path / 'run'}", *options])
        assert not (tmp_path / "run").exists()
        return str(file), capsys.readouterr().err

    return of


def test_files_are_checked_together_with_the_curricula_that_they_give():
    cfg = conf.compose(["task=quadruped_velocity_flat"])
    ranges = OwnFile(path="mine.yaml", fields=("task.commands.twist.lin_vel_x",))
    turns = OwnFile(path="turns.yaml", fields=("task.commands.twist.lin_vel_y", "seed"))
    stages = OwnFile(
        path="stages.yaml", fields=("task.curriculum.command_ranges.stages.9.lin_vel_x",)
    )
    conf.check_files_not_replaced(cfg, [turns], [])
    conf.check_files_not_replaced(cfg, [ranges, stages], [])
    conf.check_files_not_replaced(cfg, [ranges], [f"{stages.fields[0]}=[0,1]"])
    with pytest.raises(ValueError, match=f"^mine.yaml: {ranges.fields[0]}: {REPLACED}"):
        conf.check_files_not_replaced(cfg, [turns, ranges], [])


def test_an_error_about_a_field_names_its_file():
    own = [OwnFile(path="mine.yaml", fields=("objective.clip_epsilon", "task.sim.njmax"))]
    named = r"^mine.yaml: objective.clip_epsilon='x': expected"
    with pytest.raises(ValueError, match=named), conf.naming_files(own):
        raise ValueError("objective.clip_epsilon='x': expected a number")
    with pytest.raises(ValueError, match=r"^task.sim.nconmax=-1"), conf.naming_files(own):
        raise ValueError("task.sim.nconmax=-1: too small")


@pytest.mark.full
def test_a_file_that_gives_what_a_curriculum_replaces_is_refused_by_its_name(refusal):
    file, error = refusal("mine.yaml", PRIMARY + RANGE, "--config-name", "mine")
    assert f"{file}: task.commands.twist.lin_vel_x: {REPLACED}" in error


@pytest.mark.full
def test_so_is_a_choice_of_a_group(refusal):
    text = "# @package _global_\n" + RANGE
    options = ("task=quadruped_velocity_flat", "+experiment=slow")
    file, error = refusal("experiment/slow.yaml", text, *options)
    assert f"{file}: task.commands.twist.lin_vel_x: {REPLACED}" in error


@pytest.mark.full
def test_an_unknown_field_is_refused_with_its_file_and_the_near_names(refusal):
    text = PRIMARY + "objective: {clip_eps: 0.1}\n"
    file, error = refusal("mine.yaml", text, "--config-name", "mine")
    assert (
        f"{file}: unknown field 'objective.clip_eps' of PPOCfg: did you mean 'clip_epsilon'"
        in error
    )


@pytest.mark.full
def test_a_bad_value_is_refused_with_its_file(refusal):
    text = PRIMARY + "objective: {clip_epsilon: many}\n"
    file, error = refusal("mine.yaml", text, "--config-name", "mine")
    assert f"{file}: objective.clip_epsilon='many': expected" in error
