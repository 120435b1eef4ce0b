"""A run folder makes its run again, and starts others: `--config-dir RUN` and `checkpoint=RUN`."""

import csv
from contextlib import nullcontext
from importlib.resources import files

import pytest
import torch

from ksim_rl.cli import main, train
from ksim_rl.trainers import checkpoint

SMALL = (
    "task.sim.engine=c",
    "num_envs=16",
    "data.num_env_states_per_minibatch=32",
    "modules.actor.hidden_dims=[16]",
    "modules.critic.hidden_dims=[16]",
    "task.episode_length_s=0.3",
    "trainer.eval_episodes=0",
    "trainer.num_iterations=2",
    "trainer.video=false",
    "logger.tensorboard=false",
)
TIMES = ("seconds", "throughput/env_states_per_s", "warm_up_s")


def run(*arguments):
    with pytest.raises(SystemExit) as stopped:
        main.main(["train", *arguments])
    return stopped.value.code


def rows(folder):
    with open(folder / "metrics.csv", newline="") as file:
        return [
            {name: row[name] for name in row if name not in TIMES} for row in csv.DictReader(file)
        ]


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """Train two iterations, and return the run folder."""
    folder = tmp_path_factory.mktemp("work") / "run"
    assert run(*SMALL, "seed=3", f"hydra.run.dir={folder}") == 0
    return folder


def test_a_run_folder_makes_the_same_run_again(first, tmp_path):
    assert run("--config-dir", str(first), f"hydra.run.dir={tmp_path / 'again'}") == 0
    assert rows(tmp_path / "again") == rows(first)
    assert len(rows(first)) == 2
    assert (tmp_path / "again" / "config.yaml").read_text() == (first / "config.yaml").read_text()


def test_overrides_lie_over_a_run_that_is_made_again(first, tmp_path):
    changes = ("seed=4", "num_envs=8", "objective.gamma=0.9")
    assert run("--config-dir", str(first), *changes, f"hydra.run.dir={tmp_path}") == 0
    config = checkpoint.load_latest(tmp_path).config
    assert (config["seed"], config["num_envs"]) == (4, 8)
    assert "seed" not in config["task"] and "num_envs" not in config["task"]["scene"]
    assert config["objective"]["gamma"] == 0.9
    assert rows(tmp_path) != rows(first)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("objective.gama=0.9", "objective has no field 'gama': did you mean 'gamma'"),
        ("objective.gamma=2.0", "objective.gamma=2.0: expected a finite number"),
        ("task=cartpole_swingup", "a run's config has no groups"),
    ],
)
def test_a_wrong_override_of_a_run_is_one_line(
    first, tmp_path, monkeypatch, capsys, override, message
):
    monkeypatch.chdir(tmp_path)
    assert run("--config-dir", str(first), override) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("elsewhere/config.yaml", "task_name: a\ntask: {}\n", "expected a run folder"),
        ("config.yaml", "foo: 1", "expected a run folder"),
        ("config.yaml", "a: [1", "config.yaml: cannot be read: "),
        (
            "config.yaml",
            "task_name: a\ntask: null",
            "config.yaml: task=None: expected the config of an env",
        ),
    ],
)
def test_a_folder_without_a_run_is_refused_instead_of_ignored(
    tmp_path, capsys, name, text, message
):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    assert run("--config-dir", str(tmp_path), f"hydra.run.dir={tmp_path / 'run'}") == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_config_groups_of_ones_own_lie_beside_ours(tmp_path, capsys):
    (tmp_path / "logger").mkdir()
    (tmp_path / "logger" / "quiet.yaml").write_text("csv: false\ntensorboard: false\n")
    assert (
        run("--config-dir", str(tmp_path), "logger=quiet", "--cfg", "job", "--package", "logger")
        == 0
    )
    assert "csv: false" in capsys.readouterr().out


def test_a_new_run_starts_from_the_weights_of_another(first, tmp_path):
    frozen = (
        "objective.schedule=fixed",
        "objective.learning_rate=1e-30",
        "objective.learning_rate_min=1e-30",
    )
    code = run(
        *SMALL,
        *frozen,
        f"checkpoint={first}",
        "task=cartpole_swingup",
        "seed=9",
        f"hydra.run.dir={tmp_path}",
    )
    assert code == 0
    began, ended = (checkpoint.load_latest(folder) for folder in (first, tmp_path))
    assert ended.iteration == 2, "counted from its own start"
    assert ended.config["checkpoint"] == str(first)
    weights = {
        name
        for name, value in began.state["update"]["actor"].items()
        if value.dtype == torch.float32
    }
    learned = {name for name in weights if "weight" in name or "bias" in name}
    assert len(learned) >= 4
    for name in learned:
        assert torch.equal(
            began.state["update"]["actor"][name], ended.state["update"]["actor"][name]
        ), name


def test_weights_for_other_observations_are_refused_with_the_names(first, tmp_path, capsys):
    code = run(
        *SMALL, f"checkpoint={first}", "task=pendulum_swingup", f"hydra.run.dir={tmp_path / 'run'}"
    )
    assert code == 2
    error = capsys.readouterr().err
    assert "the checkpoint is of other observations: group 'actor': " in error
    assert error.count("\n") == 1, "Hydra adds no line of its own"
    assert not (tmp_path / "run" / "metrics.csv").exists()


def test_weights_of_other_networks_are_refused_with_the_way_out(first, tmp_path, capsys):
    other = "modules.actor.hidden_dims=[8]"
    assert run(*SMALL, f"checkpoint={first}", other, f"hydra.run.dir={tmp_path}") == 2
    error = capsys.readouterr().err
    assert f"{first}: its networks are others: actor: " in error
    assert (
        "'module.0.module.trunk.0.weight' is float32[16, 5] in the checkpoint and float32[8, 5] in this run"
        in error
    )


def test_a_run_names_its_teacher_so_that_it_is_found_from_anywhere(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(train, "run_and_report", lambda cfg, folder: seen.append(cfg) or 0)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "check_sources", lambda cfg: None)
    assert run("objective=distillation", "objective.teacher=runs/expert") == 0
    assert seen[0].objective.teacher == str(tmp_path / "runs" / "expert")


@pytest.mark.full
def test_a_run_is_made_again_from_its_own_weights(first, tmp_path):
    code = run(
        "--config-dir", str(first), f"checkpoint={first}", "seed=5", f"hydra.run.dir={tmp_path}"
    )
    config = checkpoint.load_latest(tmp_path).config
    assert code == 0 and (config["seed"], config["checkpoint"]) == (5, str(first))


@pytest.mark.full
def test_a_sweep_of_a_run_made_again(first, tmp_path):
    axes = ("seed=1", "objective.clip_epsilon=0.1,0.2", "trainer.num_iterations=1")
    assert run("--multirun", "--config-dir", str(first), *axes, f"hydra.sweep.dir={tmp_path}") == 0
    found = sorted(
        (config["seed"], config["objective"]["clip_epsilon"])
        for config in (checkpoint.load_latest(f).config for f in tmp_path.iterdir() if f.is_dir())
    )
    assert found == [(1, 0.1), (1, 0.2)]


@pytest.mark.full
def test_each_job_of_a_sweep_that_fails_says_so_and_the_others_run(first, tmp_path, capsys):
    widths = (f"checkpoint={first}", "modules.actor.hidden_dims=[8],[16],[9]")
    assert run("--multirun", *SMALL, *widths, f"hydra.sweep.dir={tmp_path / 'sweep'}") == 2
    errors = capsys.readouterr().err.splitlines()
    assert [error.split(" (")[0] for error in errors] == [
        "ksim-rl: error: job 0",
        "ksim-rl: error: job 2",
    ]
    assert all("its networks are others" in error for error in errors)
    (done,) = [folder for folder in (tmp_path / "sweep").iterdir() if folder.is_dir()]
    assert checkpoint.load_latest(done).iteration == 2


@pytest.mark.full
@pytest.mark.parametrize("seeds", ["1,2"])
def test_a_sweep_runs_in_the_processes_of_another_launcher(tmp_path, seeds):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    launcher = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    assert run("--multirun", *launcher, *SMALL, f"seed={seeds}", f"hydra.sweep.dir={tmp_path}") == 0
    saved = [checkpoint.load_latest(f) for f in tmp_path.iterdir() if f.is_dir()]
    assert sorted(entry.config["seed"] for entry in saved) == [1, 2]


def test_a_run_keeps_its_model_in_other_folders_and_after_edits(tmp_path, monkeypatch, capsys):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    robot = tmp_path / "robot.xml"
    robot.write_text(files("ksim_rl.scene.robots").joinpath("cartpole.xml").read_text())
    described = "{_target_:ksim_rl.scene.scene.MjcfRobot,source:robot.xml}"
    own = (
        "task=cartpole_swingup",
        "~task.scene.robots.cartpole",
        f"+task.scene.robots.cartpole={described}",
    )
    assert run(*SMALL, *own, "hydra.run.dir=run") == 0
    robot.write_text(robot.read_text().replace('mass="0.1"', 'mass="0.2"'))
    capsys.readouterr()
    assert run("--config-dir", "run", "hydra.run.dir=again") == 0
    said = capsys.readouterr().err
    assert said.count("robot.xml has changed since the run began: the run's own copy is used") == 1
    assert rows(tmp_path / "again") == rows(tmp_path / "run")
    monkeypatch.chdir(tmp_path / "elsewhere")
    for command in (
        ["eval", "../run", "--episodes", "1"],
        ["resume", "../run", "--num-iterations", "3"],
    ):
        with (
            pytest.warns(UserWarning) if command[0] == "eval" else nullcontext(),
            pytest.raises(SystemExit) as stopped,
        ):
            main.main(command)
        assert stopped.value.code in (0, 1)
    assert len(rows(tmp_path / "run")) == 3
