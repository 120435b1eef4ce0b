"""`ksim-rl collect` writes the episodes that a policy has in its env, as many of each env, and says how they were."""

import json
import os
import signal

import pytest
import torch
from omegaconf import OmegaConf

from ksim_rl import data
from ksim_rl.cli.main import main
from ksim_rl.collectors import RolloutCollector
from ksim_rl.runs import record
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.viewer.session import UntrainedAgent

# Episodes of 20 env steps, on the engine that compiles nothing.
SHORT = ("task.episode_length_s=0.2", "task.sim.engine=c", "--device", "cpu")
TASK = ("task=cartpole_swingup", "--agent", "zero", *SHORT)


def run(*words):
    with pytest.raises(SystemExit) as stopped:
        main(["collect", *words])
    return stopped.value.code


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work") / "episodes"
    words = ("--episodes", "5", "--num-envs", "2", "--seed", "3", "--output", str(folder))
    assert run(*TASK, *words, "--lerobot") == 0
    return folder


def test_each_env_gives_as_many_episodes_which_are_those_of_the_env(collected):
    found = data.read_episodes(collected)
    assert found.contents.num_episodes == found.contents.asked == 5
    tree = OmegaConf.to_container(OmegaConf.load(collected / "config.yaml"))
    cfg = RunCfg.from_tree(tree)
    env = build_env(cfg, num_envs=2, seed=3)
    steps = env.base_env.max_episode_length
    assert steps == 20

    rollout_ET = env.rollout(3 * steps, UntrainedAgent("zero", env), break_when_any_done=False)
    expected = torch.cat(
        [rollout_ET[env, k * steps : (k + 1) * steps] for k in range(3) for env in range(2)]
    )
    own = found.env_states_D
    assert own.shape == (5 * steps,)
    for key in own.exclude("episode").keys(True, True):
        assert torch.equal(own[key], expected[: 5 * steps][key]), key


def test_the_folder_tells_where_it_came_from(collected):
    origin = data.read_episodes(collected).contents.origin
    assert (origin.task, origin.policy) == ("cartpole_swingup", "cartpole_swingup, zero actions")
    assert origin.step_dt == pytest.approx(0.01)
    assert origin.columns["actor"] == {
        "obs/position": (0, 3),
        "obs/velocity": (3, 5),
    }
    assert len(origin.model_sha256) == 64 and origin.weights_sha256 == ""
    session = record.read(collected)[-1]
    assert session.status == "done"
    assert "torch" in session.versions


def test_it_is_a_dataset_of_lerobot_too(collected):
    info = json.loads((collected / "lerobot" / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (5, 100, 100)
    assert info["features"]["observation.state"]["shape"] == [5]


def test_an_interrupted_recording_says_what_is_whole(tmp_path, monkeypatch, capsys):
    collect = RolloutCollector.collect
    calls = []

    def collect_and_interrupt(self):
        calls.append(self)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return collect(self)

    monkeypatch.setattr(RolloutCollector, "collect", collect_and_interrupt)
    folder = tmp_path / "episodes"
    assert run(*TASK, "--episodes", "40", "--num-envs", "2", "--output", str(folder)) == 130
    assert "SIGINT: 6 of 40 episodes are whole" in capsys.readouterr().err
    assert data.read_episodes(folder).contents.num_episodes == 6
    assert record.read(folder)[-1].status == "interrupted"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("task=cartpole_swingup",), "task=NAME with --agent zero or random"),
        (("RUN", "--episodes", "0"), "--episodes=0: expected a whole number >= 1"),
        (("RUN", "--num-envs", "0"), "--num-envs=0: expected a whole number >= 1"),
        (
            (*TASK, "task.episode_length_s=0", "~task.terminations.time_out"),
            "give one, task.episode_length_s=20",
        ),
        ((*TASK, "--output", "."), ".: it holds something: name a new folder"),
        (("nowhere",), "nowhere"),
    ],
)
def test_what_cannot_be_collected_is_refused_in_one_line(
    words, said, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").touch()
    assert run(*words) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [tmp_path / "mine"]
