"""What is wrong with a command is said in one line before anything is built, with nothing left behind."""

import pytest

from ksim_rl.cli import run_commands
from ksim_rl.cli.main import COMMANDS
from ksim_rl.trainers import checkpoint
from tests.conf.test_command_line import run

DISTIL = ("objective=distillation",)


@pytest.fixture(autouse=True)
def work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path / "no_robots"))
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["checkpoint=nowhere"],
            "checkpoint=nowhere: nowhere: no checkpoint here; expected a run folder",
        ),
        (
            ["--multirun", "checkpoint=nowhere,there"],
            "checkpoint=nowhere: nowhere: no checkpoint here",
        ),
        (
            [*DISTIL, "objective.teacher=expert"],
            "objective.teacher=expert: expert: no checkpoint here",
        ),
        (
            ["trainer.stop_at={reward/balnce: 1}"],
            "no metric is called 'reward/balnce': did you mean 'reward/balance'",
        ),
        (["trainer.stop_at={episode/retrun: 1}"], "did you mean 'episode/return'"),
        (["trainer.stop_at={return: 1}"], "trainer.stop_at: no metric is called 'return'"),
        (
            ["trainer.stop_at={evaluation/return_mean: 1}", "trainer.eval_episodes=0"],
            "no metric is called 'evaluation",
        ),
        (["task=go1_velocity_flat"], "task.scene.robots."),
        (["--num_envs=4"], "--num_envs=4: fields are set without dashes: num_envs=4"),
        (["--num-envs", "4"], "--num-envs: fields are set without dashes: num_envs=4"),
        (
            ["--task", "cartpole_swingup"],
            "--task: fields are set without dashes: task=cartpole_swingup",
        ),
        (["--num_iterations=9"], "fields are set without dashes: trainer.num_iterations=9"),
        (["--objective.gamma", "0.9"], "fields are set without dashes: objective.gamma=0.9"),
        (["--num_env=4"], "no such flag, and no field 'num_env': did you mean 'num_envs'"),
        (
            ["cartpole_swingup"],
            "'cartpole_swingup': expected name=value: did you mean task=cartpole_swingup",
        ),
        (["cartpole_swingpu"], "did you mean task=cartpole_swingup"),
    ],
)
def test_train_refuses_in_one_line(work, capsys, arguments, message):
    code, output = run(capsys, "train", *arguments)
    assert code == 2 and message in output.err
    assert output.err.count("\n") == 1 and output.out == "", "no banner, no usage"
    assert list(work.iterdir()) == []


def test_a_run_folder_alone_is_answered_with_what_can_be_done_with_it(work, capsys):
    (work / "run").mkdir()
    (work / "run" / "config.yaml").write_text("")
    code, output = run(capsys, "train", "run")
    assert code == 2 and output.err.count("\n") == 1
    for way in ("--config-dir run", "checkpoint=run", "ksim-rl resume run"):
        assert way in output.err


@pytest.mark.parametrize("command", sorted({*COMMANDS} - {"train", "warmup"}))
def test_flags_that_do_not_exist_are_one_line_of_any_command(capsys, command):
    kind = {"new": ["robot"], "motion": ["csv", "source"], "completion": ["bash"]}.get(command, [])
    code, output = run(capsys, command, *kind, "x", "--no-such-flag")
    assert code == 2 and output.err.count("\n") == 1 and "--no-such-flag" in output.err


def test_warmup_refuses_as_train_does(work, capsys):
    code, output = run(capsys, "warmup", "--num_envs=4")
    assert code == 2 and "fields are set without dashes: num_envs=4" in output.err


@pytest.fixture
def resumed(work, monkeypatch):
    """A run of 3 iterations, and the configs with which runs were resumed."""
    from ksim_rl import conf

    config = conf.compose(["num_envs=64"]).to_tree()
    (work / "run").mkdir()
    checkpoint.save(work / "run" / "checkpoint", {}, iteration=3, config=config)
    seen = []
    monkeypatch.setattr(
        run_commands, "run_and_report", lambda cfg, folder, resume_from: seen.append(cfg) or 0
    )
    return seen


def test_resume_takes_overrides(resumed, capsys):
    changes = (
        "objective.learning_rate=1e-5",
        "trainer.num_iterations=50",
        "task.rewards.balance.weight=2.0",
    )
    assert run(capsys, "resume", "run", *changes)[0] == 0
    assert run(capsys, "resume", "run", "--num-iterations", "7", "objective.gamma=0.9")[0] == 0
    first, second = resumed
    assert (first.objective.learning_rate, first.trainer.num_iterations, first.num_envs) == (
        1e-5,
        50,
        64,
    )
    assert first.task.rewards["balance"].weight == 2.0
    assert (second.trainer.num_iterations, second.objective.gamma) == (7, 0.9)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("objective.gama=0.9", "did you mean 'gamma'"),
        ("objective.gamma=2", "objective.gamma=2"),
        ("num_envs=32", "ksim-rl train --config-dir run checkpoint=run num_envs=..."),
        ("modules.actor.hidden_dims=[8]", "modules.actor.hidden_dims: a resumed run keeps it"),
        ("task=cartpole_swingup", "a run's config has no groups"),
        ("trainer.num_iterations=2", "expected at least 3"),
        ("trainer.stop_at={reward/x: 1}", "no metric is called 'reward/x'"),
        ("--seed=3", "unrecognized arguments: --seed=3"),
    ],
)
def test_resume_refuses_in_one_line(resumed, capsys, override, message):
    code, output = run(capsys, "resume", "run", override)
    assert code == 2 and message in output.err and output.err.count("\n") == 1
    assert not resumed and output.out == ""
