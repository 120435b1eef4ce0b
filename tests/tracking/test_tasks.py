"""The tasks keep the contract of envs, and learn without an error."""

import math

from ksim_rl import conf, envs
from ksim_rl.runs.csv_table import read_table
from ksim_rl.scene.motions.motion import motion_path
from ksim_rl.testing import check_env
from ksim_rl.tracking.tasks import BODIES, TASKS
from ksim_rl.trainers import RunProgress, run
from tests.tracking.g1 import g1_model

NAMES = [task.name for task in TASKS]
SETS = ("g1_track", "g1_track_assisted")
SINGLE = [task for task in TASKS if task.name not in SETS]


def test_there_is_a_motion_for_each_task_that_fits_into_an_episode():
    assert NAMES == [
        "g1_track",
        "g1_track_assisted",
        "g1_track_walk",
        "g1_track_squat",
        "g1_track_turn",
        "g1_track_kick",
        "g1_track_step",
        "g1_track_sit",
    ]
    for task in SINGLE:
        cfg = task.cfg()
        clip = cfg.events["start"].file
        assert motion_path(clip).is_file() and clip == f"g1_{task.name.removeprefix('g1_track_')}"
        assert {term.file for term in cfg.rewards.values() if hasattr(term, "file")} == {clip}


def test_an_env_passes_the_checks_and_has_the_peers_observations():
    g1_model()
    env = envs.make("g1_track_kick", num_envs=3, seed=0)
    check_env(env)
    reference, own, action, bodies = 2 * 29, 3 + 6 + 3 + 3 + 2 * 29, 29, 9 * len(BODIES)
    assert env.observation_spec["actor"].shape[-1] == reference + own + action
    assert env.observation_spec["critic"].shape[-1] == reference + own + action + bodies
    assert env.base_env.max_episode_length >= env.base_env.view.motion("g1_kick").duration_s / 0.02
    env.close()


def test_two_iterations_of_training(tmp_path):
    g1_model()
    cfg = conf.compose(
        ["task=g1_track", "num_envs=4", "device=cpu", "data.num_env_states_per_minibatch=8"]
        + [
            "task.sim.engine=c",
            "data.num_minibatches=4",
            "trainer.num_iterations=2",
            "trainer.eval_episodes=0",
            "trainer.video=false",
        ]
    )
    outcome = run(cfg, tmp_path / "run", progress=RunProgress(2))
    assert outcome.env_states == 2 * 32
    _, lines = read_table(tmp_path / "run" / "metrics.csv")
    assert all(
        math.isfinite(float(line[name])) for line in lines for name in ("loss/policy", "loss/value")
    )
