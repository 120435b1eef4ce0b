"""A mistake on the command line ends with one line that names the near names, and exit code 2."""

import gc
import subprocess
import sys

import pytest

from ksim_rl import conf
from ksim_rl.cli import main, run_commands


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stopped:
        main.main(list(arguments))
    return stopped.value.code, capsys.readouterr()


WRONG = [
    ("task=cartpole_balanc", "unknown task 'cartpole_balanc': did you mean 'cartpole_balance'"),
    ("taks=cartpole_balance", "unknown field 'taks': did you mean 'task'"),
    (
        "rewards.balance.weight=2",
        "unknown field 'rewards.balance.weight': did you mean 'task.rewards.balance.weight'",
    ),
    ("gamma=0.9", "unknown field 'gamma': did you mean 'objective.gamma'"),
    ("objective=ppoo", "unknown objective 'ppoo': did you mean 'ppo'"),
    ("nun_envs=3", "did you mean 'num_envs'"),
    (
        "objective.learning_rat=1",
        "objective has no field 'learning_rat': did you mean 'learning_rate'",
    ),
    ("task.rewards.balanc.weight=2", "task.rewards has no field 'balanc': did you mean 'balance'"),
    ("+objective.learn=1", "unknown field 'objective.learn' of PPOCfg"),
    ("num_envs=abc", "num_envs='abc': expected int"),
    ("num_envs=1000", "num_envs=512 or 1024"),
    ("objective.gamma=1.5", "objective.gamma=1.5: expected a finite number in [0.0, 1.0]"),
    ("modules.actor.activation=eluu", "modules.actor.activation='eluu': did you mean 'elu'"),
    ("task.rewards.balance._target_=os.system", "only classes of these packages are built"),
    ("seed=1,2", "add --multirun"),
    ("data.num_minibatches=[1", "does not parse"),
    ("checkpoint=/robots/a (1)", """for the shell too: 'checkpoint="/robots/a (1)"'"""),
    ("checkpoint=/a=b", """'checkpoint="/a=b"'"""),
    ("checkpoint=~/run", """'checkpoint="~/run"'"""),
    ("checkpoint=/rüben", """'checkpoint="/rüben"'"""),
    ("checkpoint=/a,b", """'checkpoint="/a,b"'"""),
    ("just_a_word", "does not parse"),
    ("task_name=cartpole_swingup", "the name comes with the task; choose that with task=name"),
    ("~logger", "a run needs each group; choose another with logger=name: local, "),
    (
        "trainer.num_threads=100000",
        "trainer.num_threads=100000: expected a whole number of at most 1024",
    ),
]


@pytest.mark.parametrize(("override", "message"), WRONG)
def test_a_wrong_override_is_one_line_with_the_way_out(
    capsys, tmp_path, monkeypatch, override, message
):
    monkeypatch.chdir(tmp_path)
    code, output = run(capsys, "train", override)
    assert code == 2
    assert message in output.err
    assert output.err.count("\n") == 1
    assert output.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("override", "message"), WRONG)
def test_python_is_told_the_same_as_the_command_line(override, message):
    with pytest.raises(ValueError) as raised:
        conf.compose([override])
    assert message in str(raised.value) and "\n" not in str(raised.value)


def test_every_job_of_a_sweep_is_checked_before_the_first_starts(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, output = run(capsys, "train", "--multirun", "objective.gamma=0.9,0.99,2.0")
    assert code == 2
    assert "objective.gamma=2.0" in output.err
    assert list(tmp_path.iterdir()) == []


def test_a_traceback_is_shown_on_request(capsys, monkeypatch):
    monkeypatch.setenv("KSIM_RL_TRACEBACK", "1")
    code, output = run(capsys, "train", "nun_envs=3")
    assert code == 2 and "Traceback" in output.err and "did you mean 'num_envs'" in output.err


def test_an_error_that_nobody_foresaw_shows_its_traceback_and_is_not_an_unsolved_run(
    capsys, monkeypatch
):
    def fault(_):
        raise KeyError("weight")

    monkeypatch.setattr(run_commands, "list_envs", fault)
    code, output = run(capsys, "envs")
    assert code == 3
    assert "in fault" in output.err and output.err.endswith("ksim-rl: error: KeyError: 'weight'\n")


def test_a_config_that_hydra_cannot_find_is_one_line(capsys):
    code, output = run(capsys, "train", "--config-name", "nowhere")
    assert code == 2
    assert "Cannot find primary config 'nowhere'" in output.err and output.err.count("\n") == 1


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--seconds", "inf"), "--seconds=inf: expected a finite number"),
        (("--output", "clip.txt"), "--output clip.txt: expected a file that ends in .mp4 or .gif"),
    ],
)
def test_a_video_that_cannot_be_is_refused_before_a_policy_is_read(capsys, option, message):
    code, output = run(capsys, "play", "nowhere", *option)
    assert code == 2 and message in output.err


def test_cfg_job_prints_the_composed_config(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main_code, output = run(capsys, "train", "task=cartpole_swingup", "num_envs=32", "--cfg", "job")
    assert main_code == 0
    assert "num_envs: 32" in output.out
    assert "task_name: cartpole_swingup" in output.out
    assert list(tmp_path.iterdir()) == []


def test_help_lists_the_tasks_and_the_groups(capsys):
    code, output = run(capsys, "train", "--help")
    assert code == 0
    assert "cartpole_balance, cartpole_balance_pixels" in output.out
    for group in ("collector", "data", "objective", "modules", "trainer", "logger"):
        assert f"\n{group}: " in output.out
    assert "task/training" not in output.out, "of the groups that nobody chooses from"


@pytest.mark.parametrize("arguments", [[], ["--help"], ["help"]])
def test_usage_names_every_command(capsys, arguments):
    code, output = run(capsys, *arguments)
    assert code == (0 if arguments else 2)
    for command in main.COMMANDS:
        assert f"  {command} " in output.out


def test_an_unknown_command_is_answered_with_the_near_one(capsys):
    code, output = run(capsys, "trian")
    assert (code, output.err) == (
        2,
        "ksim-rl: error: unknown command 'trian': did you mean 'train'?\n",
    )


def test_envs_lists_each_task_in_one_line(capsys):
    code, output = run(capsys, "envs")
    lines = output.out.splitlines()
    assert code == 0
    assert lines[0].split()[:2] == ["task", "robot"]
    assert any(line.startswith("cartpole_swingup") and "swing" in line for line in lines)


def test_envs_prints_what_one_task_is_made_of(capsys):
    code, output = run(capsys, "envs", "cartpole_balance")
    assert code == 0
    assert "episodes of 10 s = 1000 steps" in output.out.splitlines()[0]
    assert " ".join(output.out.split()).count("0 balance 1 CartpoleReward()") == 1
    code, output = run(capsys, "envs", "cartpole_balanse")
    assert code == 2 and "did you mean 'cartpole_balance'" in output.err


@pytest.mark.parametrize("command", ["eval", "play", "resume"])
def test_a_run_that_is_not_there_is_one_line(capsys, tmp_path, command):
    code, output = run(capsys, command, str(tmp_path / "nowhere"))
    assert code == 2
    assert "no checkpoint here; expected a run folder" in output.err
    assert output.err.count("\n") == 1


# Runs in a process of its own, as the command does.
START = """
import gc, sys
from ksim_rl.cli import main
try:
    main.main(["train", "--cfg", "job"])
finally:
    assert gc.isenabled() and gc.get_freeze_count() > 100_000, gc.get_freeze_count()
    slow = {"matplotlib", "tensorboard", "wandb", "mlflow"} & set(sys.modules)
    assert not slow, slow
"""


def test_the_command_starts_without_what_only_later_parts_need(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", START], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_the_objects_of_a_program_that_calls_the_command_are_left_alone(capsys):
    frozen = gc.get_freeze_count()
    assert run(capsys, "envs")[0] == 0
    # Some of the frozen may have gone meanwhile.
    assert gc.isenabled() and gc.get_freeze_count() <= frozen
