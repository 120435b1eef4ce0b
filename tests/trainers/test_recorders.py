"""Recorders keep whole episodes of a training, and change nothing of it."""

import dataclasses

import pytest
import torch

from ksim_rl import conf, data
from ksim_rl.data import RecorderCfg
from ksim_rl.data.episode_writer import EpisodeWriter
from ksim_rl.device import room
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.build import build, build_env

SMALL = (
    "task=cartpole_swingup",
    "device=cpu",
    "num_envs=4",
    "task.sim.engine=c",
    "task.episode_length_s=0.1",
    "data.num_env_states_per_minibatch=16",
    "data.num_minibatches=2",
    "modules.actor.hidden_dims=[8]",
    "modules.critic.hidden_dims=[8]",
    "trainer.num_iterations=6",
    "trainer.eval_episodes=0",
    "logger=none",
)


class Listening:
    """Keeps each rollout."""

    def __init__(self):
        self.rollouts = []

    def record(self, rollout_ET, *, restarted=False):
        self.rollouts.append(rollout_ET.clone())

    def close(self):
        pass


def train(folder, **recorders):
    cfg = dataclasses.replace(conf.compose(list(SMALL)), recorders=recorders)
    trainer = build(cfg, run_folder=folder)
    listening = Listening()
    trainer.collector.listeners.append(listening)
    trainer.train()
    return trainer, torch.cat(listening.rollouts, dim=1)


def episodes_in(rollout_ET, env):
    """The whole episodes of an env, found step by step."""
    found = []
    began = 0
    for t, done in enumerate(rollout_ET["next", "done"][env].flatten().tolist()):
        if done:
            found.append(rollout_ET[env, began : t + 1])
            began = t + 1
    return found


def test_episodes_are_those_of_the_rollouts_and_the_training_is_the_same(tmp_path):
    plain, _ = train(None)
    recorder = RecorderCfg(num_envs=2, num_episodes=5, keys=("obs/position", "action"))
    later = RecorderCfg(num_envs=1, num_episodes=50, from_iteration=3)
    trainer, rollout_ET = train(tmp_path, some=recorder, later=later)
    for name, value in plain.update.state_dict()["actor"].items():
        assert torch.equal(value, trainer.update.state_dict()["actor"][name]), name

    some = data.read_episodes(tmp_path / "episodes" / "some" / "from_iteration_000001")
    keys = set(some.env_states_D.keys(True, True))
    assert keys == {("obs", "position"), "action", ("next", "done"), "episode"}
    assert some.contents.num_episodes == 5
    expected = [*episodes_in(rollout_ET, 0)[:3], *episodes_in(rollout_ET, 1)[:2]]
    own = [some.env_states_D[some.env_states_D["episode"] == number] for number in range(5)]
    actions = sorted(episode["action"].flatten().tolist() for episode in own)
    assert actions == sorted(episode["action"].flatten().tolist() for episode in expected)

    # From the third rollout on, without the episode that ran when it began.
    rest = data.read_episodes(tmp_path / "episodes" / "later" / "from_iteration_000001")
    length = rollout_ET.shape[1] // 6
    expected = torch.cat(episodes_in(rollout_ET[:, 2 * length :], 0)[1:])
    own_D = rest.env_states_D.exclude("episode")
    assert len(own_D) > 10
    assert (own_D == expected.select(*own_D.keys(True, True))).all()
    assert rest.env_states_D["next", "obs", "velocity"].shape[1] == 2


def test_a_full_disk_costs_the_recording_and_not_the_run(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(EpisodeWriter, "append", fail)
    with pytest.warns(RuntimeWarning, match="No space left on device: nothing more is recorded"):
        trainer, _ = train(tmp_path, all=RecorderCfg(num_envs=4))
    assert trainer.iteration == 6


@pytest.mark.parametrize(
    ("name", "recorder", "message"),
    [
        ("all", RecorderCfg(num_envs=5), "recorders.all.num_envs=5: expected at most num_envs=4"),
        ("all", RecorderCfg(num_envs=1, keys=("obs/positon",)), "did you mean 'obs/position'"),
        ("../all", RecorderCfg(num_envs=1), "recorders.../all: expected letters"),
    ],
)
def test_what_cannot_be_recorded_is_refused_by_name(tmp_path, name, recorder, message):
    with pytest.raises(ValueError, match=message):
        train(tmp_path, **{name: recorder})


def test_a_run_that_goes_on_writes_another_folder(tmp_path):
    recorder = RecorderCfg(num_envs=1, num_episodes=1)
    cfg = dataclasses.replace(conf.compose(list(SMALL)), recorders={"all": recorder})
    for _ in range(2):
        build(cfg, run_folder=tmp_path).train()
    names = sorted(path.name for path in (tmp_path / "episodes" / "all").iterdir())
    assert names == ["from_iteration_000001", "from_iteration_000001_2"]


def test_a_resumed_run_does_not_record_the_episode_that_ran_as_a_whole_one(tmp_path):
    words = [word for word in SMALL if "num_iterations" not in word and "length_s" not in word]
    cfg = conf.compose([*words, "trainer.num_iterations=3", "task.episode_length_s=0.15"])
    build(cfg, run_folder=tmp_path).train()
    saved = checkpoint.load_latest(tmp_path)
    going_on = dataclasses.replace(
        cfg,
        trainer=dataclasses.replace(cfg.trainer, num_iterations=9),
        recorders={"all": RecorderCfg(num_envs=4)},
    )
    trainer = build(going_on, run_folder=tmp_path, resume_from=saved)
    listening = Listening()
    trainer.collector.listeners.append(listening)
    trainer.train()
    rollout_ET = torch.cat(listening.rollouts, dim=1)
    expected = []
    for env in range(4):
        # The first to end had begun before.
        expected += episodes_in(rollout_ET, env)[1:]
    recorded = data.read_episodes(tmp_path / "episodes" / "all" / "from_iteration_000004")
    assert len(expected) > 0
    own = sorted(recorded.env_states_D["action"].flatten().tolist())
    assert own == sorted(torch.cat(expected)["action"].flatten().tolist())


def test_an_update_that_keeps_env_states_is_told_where_all_envs_were_reset(tmp_path):
    words = [word for word in SMALL if "minibatch" not in word and "modules" not in word]
    cfg = conf.compose(
        [
            *words,
            "objective=fast_sac",
            "data.num_env_states_per_minibatch=8",
            "objective.compile=false",
        ]
    )
    trainer = build(cfg, run_folder=tmp_path)
    told = []
    trainer.update.restarted = lambda: told.append(True)
    collector = trainer.collector
    collector.collect()
    collector.collect()
    assert len(told) == 1, "before the first one"
    state = trainer.state_dict()
    collector.reset()
    collector.collect()
    assert len(told) == 2
    # Episodes go on that ran when the state was taken.
    trainer.load_state_dict(state)
    collector.collect()
    assert len(told) == 2


def test_a_replay_keeps_no_leaf_that_a_recorder_alone_reads(tmp_path):
    words = [word for word in SMALL if "minibatch" not in word and "modules" not in word]
    words += [
        "objective=fast_sac",
        "data.num_env_states_per_minibatch=8",
        "objective.compile=false",
    ]
    cfg = conf.compose([*words, "trainer.num_iterations=1"])
    of_ring = []
    for recorders in ({}, {"all": RecorderCfg(num_envs=4)}):
        trainer = build(dataclasses.replace(cfg, recorders=recorders), run_folder=tmp_path)
        trainer.train()
        ring = trainer.update.state_dict()["replay"]["ring"]
        of_ring.append({name: leaf.shape for name, leaf in ring["content"].items()})
        if recorders:
            recorded = set(trainer.rollout_ET.keys(True, True))
            assert len(recorded) > len(trainer.update.rollout_keys)
    assert of_ring[0] == of_ring[1]
    # A checkpoint of before kept them.
    state = trainer.update.state_dict()
    content = state["replay"]["ring"]["content"]
    content["pictures"] = torch.zeros(len(content["action"]), 3)
    trainer.update.load_state_dict(state)
    trainer.update(trainer.collector.collect())


def test_a_recording_and_a_replay_have_to_fit_together(tmp_path, monkeypatch):
    train(tmp_path, all=RecorderCfg(num_envs=4))
    recording = tmp_path / "episodes" / "all" / "from_iteration_000001"
    words = [word for word in SMALL if "minibatch" not in word and "modules" not in word]
    words += [
        "objective=fast_sac",
        "data.num_env_states_per_minibatch=8",
        "objective.compile=false",
    ]
    words += [f"data.offline={{source: {str(recording)!r}}}", "data.capacity=200000"]
    words += [f"modules.{name}.hidden_dims=[8]" for name in ("actor", "critic")]
    cfg = conf.compose(words)
    env = build_env(cfg, num_envs=4, seed=0)
    groups = {key for kind in (cfg.modules.actor, cfg.modules.critic) for key in kind.in_keys}
    ring_bytes = sum(4 * 200_000 * 4 * env.observation_spec[key].shape[-1] for key in groups)
    # The recording alone is some kilobytes.
    monkeypatch.setattr(room, "total_bytes", lambda device: ring_bytes + 100)
    with pytest.raises(ValueError, match="recorded env states beside the replay: takes at least"):
        build(cfg)
