"""PandaPickCube against its formulas in NumPy over MuJoCo's C engine: observations, rewards, starts, ends."""

import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.suites.manipulation.panda import DRIVEN
from tests.suites.manipulation import truth
from tests.suites.manipulation.injection import assert_near, injected

COUNT = 8


@pytest.fixture(scope="module")
def mj_model():
    return truth.panda()


@pytest.fixture(scope="module")
def env(mj_model):
    env = envs.make("panda_pick_cube", num_envs=COUNT, seed=0)
    yield env
    env.close()


def states(mj_model):
    """Random ones, and in the last two the box is in the gripper, and the hand on the floor."""
    found = truth.moments(mj_model, count=COUNT, every=40)
    data = truth.at(mj_model, found[-2])
    found[-2].qpos[9:12] = data.site("gripper").xpos + [0.005, 0.0, 0.005]
    found[-1].sensordata[:] = 1.0
    return found


def test_it_observes_and_rewards_as_the_formulas_say(env, mj_model):
    env.reset()
    moments = states(mj_model)
    observations, rewards = injected(env, moments, command="target", joints=DRIVEN)
    found_EL = torch.cat(list(observations.values()), dim=-1)
    assert_near(
        found_EL, np.stack([truth.panda_observation(mj_model, now) for now in moments]), "obs"
    )
    expected = [truth.panda_rewards(mj_model, now) for now in moments]
    assert set(rewards) == set(expected[0])
    for name, found_E in rewards.items():
        assert_near(found_E, np.array([each[name] for each in expected]), name)
    assert rewards["box_target"][-2] > 0.0 and not rewards["box_target"][:-2].any()
    assert rewards["no_floor_collision"][-1] == 0.0


def test_a_box_that_was_in_the_gripper_is_rewarded_until_the_episode_ends(env, mj_model):
    env.reset()
    moments = states(mj_model)
    injected(env, moments, command="target", joints=DRIVEN)
    moments[-2].qpos[9:12] += 0.3
    _, rewards = injected(env, moments, command="target", joints=DRIVEN)
    expected = truth.panda_rewards(mj_model, moments[-2], was_there=True)["box_target"]
    assert float(rewards["box_target"][-2]) == pytest.approx(expected, abs=1e-5)
    env.reset()
    _, rewards = injected(env, moments, command="target", joints=DRIVEN)
    assert not rewards["box_target"].any()


def test_it_has_the_sizes_and_times_of_playground(env, mj_model):
    inner = env.base_env
    assert env.observation_spec["actor"].shape[-1] == env.observation_spec["critic"].shape[-1] == 66
    assert env.full_action_spec["action"].shape[-1] == 8
    assert (inner.step_dt, inner.physics_dt) == pytest.approx((0.02, 0.005))
    assert inner.max_episode_length == 150
    ours = inner.world.mj_model
    for field in (
        "body_mass",
        "dof_damping",
        "actuator_gainprm",
        "geom_friction",
        "eq_data",
        "qpos0",
    ):
        np.testing.assert_allclose(
            getattr(ours, field), getattr(mj_model, field), atol=1e-9, err_msg=field
        )
    for option in ("iterations", "ls_iterations", "integrator", "cone", "disableflags"):
        assert getattr(ours.opt, option) == getattr(mj_model.opt, option), option


def test_targets_move_by_the_action_within_the_control_ranges(env, mj_model):
    root = env.reset()
    world = env.base_env.world
    expected_EL = np.tile(mj_model.key("home").ctrl, (COUNT, 1))
    np.testing.assert_allclose(world.ctrl_EL, expected_EL, atol=1e-6)
    random = np.random.default_rng(1)
    for _ in range(4):
        action_EL = 2.0 * random.uniform(-1.0, 1.0, size=(COUNT, 8))
        _, root = env.step_and_maybe_reset(
            root.set("action", torch.tensor(action_EL, dtype=torch.float32))
        )
        expected_EL = np.clip(
            expected_EL + 0.04 * np.clip(action_EL, -1.0, 1.0), *mj_model.actuator_ctrlrange.T
        )
        np.testing.assert_allclose(world.ctrl_EL, expected_EL, atol=1e-5)


def test_episodes_end_where_the_box_is_lost_and_after_150_steps(env):
    env.reset()
    inner = env.base_env
    places = [
        [0.7, 0.0, 0.03],
        [1.01, 0.0, 0.03],
        [0.5, -1.01, 0.03],
        [0.5, 0.0, -0.001],
        [0.5, 0.0, 1.01],
    ]
    places += [[0.99, 0.99, 0.99], [-1.01, 0.0, 0.5], [-0.99, -0.99, 0.001]]
    inner.world.qpos_EL[:, 9:12] = torch.tensor(places)
    inner.world.refresh()
    inner.driver.refreshed()
    terminated_E, truncated_E = inner.termination_manager.step(torch.ones(COUNT, dtype=torch.bool))
    assert terminated_E.tolist() == [False, True, True, True, True, False, True, False]
    assert not truncated_E.any()
    inner.driver.episode_step_E.fill_(150)
    assert inner.termination_manager.step(torch.ones(COUNT, dtype=torch.bool))[1].all()


def test_success_is_a_box_within_five_centimetres_of_its_target(env):
    env.reset()
    inner = env.base_env
    inner.command_manager.values["target"].copy_(torch.tensor([0.7, 0.0, 0.3]))
    inner.world.qpos_EL[:, 9:12] = torch.tensor([0.7, 0.0, 0.3]) + torch.tensor([0.0, 0.0, 0.051])
    inner.world.qpos_EL[0, 11] -= 0.002
    inner.world.refresh()
    inner.driver.refreshed()
    inner.metric_manager.step(torch.ones(COUNT, dtype=torch.bool))
    assert inner.metric_manager.reduced_EM[:, 0].tolist() == [1.0] + [0.0] * (COUNT - 1)


def test_boxes_and_targets_start_in_their_ranges_and_only_in_rows_that_reset(mj_model):
    env = envs.make("panda_pick_cube", num_envs=256, seed=3)
    world = env.base_env.world
    target_E3 = env.reset()["command", "target"].clone()
    first_EL, home = (
        world.qpos_EL.clone(),
        torch.tensor(mj_model.key("home").qpos, dtype=torch.float32),
    )
    assert torch.equal(first_EL[:, :9], home[:9].expand(256, 9)) and not world.qvel_EL.any()
    assert torch.allclose(first_EL[:, 11:], home[11:])
    for column, low, high in ((first_EL[:, 9], 0.5, 0.9), (first_EL[:, 10], -0.2, 0.2)):
        is_uniform(column, low, high)
    for column, low, high in zip(target_E3.T, (0.5, -0.2, 0.23), (0.9, 0.2, 0.43), strict=True):
        is_uniform(column, low, high)
    again_E3 = env.reset(env_ids=torch.arange(10))["command", "target"]
    assert torch.equal(world.qpos_EL[10:], first_EL[10:]) and torch.equal(
        again_E3[10:], target_E3[10:]
    )
    assert not torch.isclose(world.qpos_EL[:10, 9:11], first_EL[:10, 9:11]).any()
    assert not torch.isclose(again_E3[:10], target_E3[:10]).any()
    env.close()


def is_uniform(column, low, high):
    assert low <= column.min() and column.max() <= high
    share = (column - low) / (high - low)
    # Four standard errors of 256 draws.
    assert abs(float(share.mean()) - 0.5) < 4 * 0.018 and abs(float(share.std()) - 0.2887) < 0.04
