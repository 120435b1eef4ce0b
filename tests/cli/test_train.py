"""The commands end to end on a small cartpole: what a run leaves, how it is evaluated, continued and interrupted."""

import csv
import json
import signal
import sys

import imageio.v2 as imageio
import pytest

from ksim_rl.cli import main
from ksim_rl.runs import record
from ksim_rl.trainers import Trainer, checkpoint

SMALL = (
    "num_envs=16",
    "data.num_env_states_per_minibatch=32",
    "modules.actor.hidden_dims=[16]",
    "modules.critic.hidden_dims=[16]",
    "task.episode_length_s=0.3",
    "trainer.eval_episodes=4",
    "trainer.video_s=0.2",
)


def run(*arguments):
    with pytest.raises(SystemExit) as stopped:
        main.main(list(arguments))
    return stopped.value.code


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Train two iterations, and return the exit code, the run folder and what was printed."""
    folder = tmp_path_factory.mktemp("work")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["ksim-rl"])
        code = run("train", *SMALL, "trainer.num_iterations=2", f"hydra.run.dir={folder / 'run'}")
    return code, folder / "run"


def rows(folder):
    with open(folder / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_an_unsolved_run_exits_with_1_and_leaves_a_whole_run_folder(trained):
    code, folder = trained
    assert code == 1
    # The last is there where this checkout has changes.
    names = {entry.name for entry in folder.iterdir()} - {"video.mp4", "video.gif", "ksim_rl.diff"}
    assert names == {
        "checkpoint",
        "config.yaml",
        "curves.png",
        "evaluation.json",
        "metrics.csv",
        "run.json",
        "tensorboard",
    }
    assert record.status(folder) == ("done", "all 2 iterations are done")
    assert "engine: warp" in (folder / "config.yaml").read_text(), "the engine that auto chose"
    assert [row["iteration"] for row in rows(folder)] == ["1", "2"]
    assert imageio.imread(folder / "curves.png").shape[0] > 300
    figures = json.loads((folder / "evaluation.json").read_text())
    assert (figures["episodes"], figures["solved"]) == (4, False)
    assert checkpoint.load_latest(folder).iteration == 2


def test_eval_repeats_the_evaluation_of_the_run(trained, capsys):
    _, folder = trained
    figures = json.loads((folder / "evaluation.json").read_text())
    assert run("eval", str(folder)) == 1
    assert (
        f"return {figures['return_mean']:.1f} +- {figures['return_std']:.1f}"
        in capsys.readouterr().out
    )


def test_eval_in_the_c_engine_says_which_physics_judges(trained, capsys):
    _, folder = trained
    assert run("eval", str(folder), "task.sim.engine=c", "--episodes", "4") == 1
    assert (
        "on MuJoCo's C engine (trained on MuJoCo Warp): evaluation over 4"
        in capsys.readouterr().out
    )
    assert run("eval", str(folder), "task.decimation=2") == 2
    assert "task.decimation: `ksim-rl eval` changes only how worlds" in capsys.readouterr().err


def test_a_run_that_the_c_engine_trained_is_judged_in_other_physics(trained, tmp_path, capsys):
    saved = checkpoint.load_latest(trained[1])
    task = saved.config["task"]
    by_c = {**saved.config, "task": {**task, "sim": {**task["sim"], "engine": "c"}}}
    checkpoint.save(tmp_path / "checkpoint", saved.state, iteration=saved.iteration, config=by_c)
    said = "which trained it, with integrator euler instead of implicitfast, with a time step of 0.005 s"
    assert run("eval", str(tmp_path), "task.sim.engine=c", "--episodes", "4") == 1
    assert said in capsys.readouterr().out
    words = ("--seconds", "0.1", "--output", str(tmp_path / "clip.gif"))
    assert run("play", str(tmp_path), "task.sim.engine=c", *words) in (0, 3)
    output = capsys.readouterr().out
    assert said in output or "no video" in output


def test_play_records_a_video_or_says_why_not(trained, capsys, tmp_path):
    _, folder = trained
    code = run(
        "play",
        str(folder),
        "--seconds",
        "0.1",
        "--fps",
        "50",
        "--output",
        str(tmp_path / "clip.gif"),
    )
    output = capsys.readouterr().out
    if code == 0:
        assert len(imageio.mimread(tmp_path / "clip.gif")) == 5  # of 10 steps
    else:
        assert code == 3
        assert "no video: " in output
        assert "MUJOCO_GL=" in output


def test_a_run_of_another_device_plays_here_with_changes(trained, tmp_path, capsys):
    saved = checkpoint.load_latest(trained[1])
    elsewhere = {**saved.config, "device": "cuda:7"}
    checkpoint.save(
        tmp_path / "checkpoint", saved.state, iteration=saved.iteration, config=elsewhere
    )
    words = ("--device", "cpu", "--seconds", "0.1", "--output", str(tmp_path / "clip.mp4"))
    assert run("play", str(tmp_path), "task.viewer.width=64", *words) in (0, 3)
    assert "device=" not in capsys.readouterr().err


def test_resume_continues_in_the_same_folder(trained):
    _, folder = trained
    assert run("resume", str(folder), "--num-iterations", "3") == 1
    assert [row["iteration"] for row in rows(folder)] == ["1", "2", "3"]
    assert checkpoint.load_latest(folder).iteration == 3


def test_fewer_iterations_than_are_done_are_refused(trained, capsys):
    _, folder = trained
    assert run("resume", str(folder), "--num-iterations", "1") == 2
    assert (
        "trainer.num_iterations=1: expected at least 3, those that are done"
        in capsys.readouterr().err
    )


@pytest.mark.full
def test_a_sweep_runs_one_job_for_each_combination_and_ends_with_a_table(tmp_path, capsys):
    quick = ("trainer.num_iterations=1", "trainer.eval_episodes=0", "trainer.video=false")
    assert (
        run("train", "--multirun", *SMALL, *quick, "seed=1,2", f"hydra.sweep.dir={tmp_path}") == 0
    )
    seeds = {
        folder.name: checkpoint.load_latest(folder).config["seed"]
        for folder in tmp_path.iterdir()
        if folder.is_dir()
    }
    assert seeds == {"0_seed=1": 1, "1_seed=2": 2}
    head, *rows, end = capsys.readouterr().out.splitlines()[-4:]
    assert head.split()[:3] == ["run", "task", "status"] and end.startswith(str(tmp_path))
    assert [row.split()[:3] for row in rows] == [
        ["0_seed=1", "cartpole_balance", "done"],
        ["1_seed=2", "cartpole_balance", "done"],
    ]


def test_a_damaged_checkpoint_is_one_line(trained, capsys, tmp_path):
    _, folder = trained
    copy = tmp_path / "00000002"
    copy.mkdir()
    for entry in checkpoint.saved(folder / "checkpoint")[0].iterdir():
        (copy / entry.name).write_bytes(entry.read_bytes()[:-1])
    assert run("eval", str(copy)) == 2
    assert "damaged" in capsys.readouterr().err


def test_ctrl_c_saves_and_exits_with_130(tmp_path, monkeypatch, capsys):
    endless = (
        "trainer.num_iterations=100000",
        "trainer.eval_interval=0",
        f"hydra.run.dir={tmp_path}",
    )
    iterate = Trainer.iterate

    def iterate_until_ctrl_c(trainer):
        iterate(trainer)
        if trainer.iteration == 2:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Trainer, "iterate", iterate_until_ctrl_c)
    monkeypatch.setattr(sys, "argv", ["ksim-rl", "train", *SMALL, *endless])
    assert run("train", *SMALL, *endless) == 130
    assert "SIGINT: everything is saved; continue with: ksim-rl resume" in capsys.readouterr().out
    assert checkpoint.load_latest(tmp_path).iteration >= 2
    (session,) = record.read(tmp_path)
    assert (session.status, session.why) == ("interrupted", "SIGINT")
    assert (
        session.command.endswith(f"hydra.run.dir={tmp_path}")
        and " train num_envs=16 " in session.command
    )


def test_what_an_export_will_leave_out_is_said_before_the_first_iteration(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    noise = "{_target_:ksim_rl.transforms.GaussianNoise,std:0.1}"
    target = "ksim_rl.transforms.ObservationNoise"
    own = f"+task.transforms.noise={{_target_:{target},in_keys:[actor],noise:{noise}}}"
    quick = (
        "trainer.num_iterations=1",
        "trainer.video=false",
        "trainer.eval_episodes=0",
        "task.sim.engine=c",
    )
    run("train", *SMALL, *quick, own, f"hydra.run.dir={tmp_path / 'run'}")
    said = capsys.readouterr().out
    assert "task.transforms.noise acts in training only" in " ".join(said.split())
