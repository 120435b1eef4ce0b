"""LeapCubeReorient against its formulas in NumPy over MuJoCo's C engine: observations, rewards, goals, starts, ends."""

import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.suites.manipulation.leap import HAND
from tests.suites.manipulation import truth
from tests.suites.manipulation.injection import assert_near, injected

COUNT = 8


@pytest.fixture(scope="module")
def mj_model():
    return truth.leap()


@pytest.fixture(scope="module")
def env(mj_model):
    env = envs.make("leap_cube_reorient", num_envs=COUNT, seed=0)
    yield env
    env.close()


def states(mj_model):
    """Random ones; in the last two the goal is near, and the cube has fallen."""
    found = truth.moments(mj_model, count=COUNT, every=20)
    found[-2].wanted = truth.turned(found[-2].qpos[19:], np.array([0.09, 0.0, 0.0]), 1.0)
    found[-1].qpos[18] = -0.06
    return found


def test_it_observes_and_rewards_as_the_formulas_say(env, mj_model):
    env.reset()
    moments = states(mj_model)
    observations, rewards = injected(env, moments, command="goal", joints=HAND)
    still = np.zeros(16)
    expected = [truth.leap_observations(mj_model, now, still) for now in moments]
    assert set(observations) == set(expected[0])
    for name, found_EL in observations.items():
        assert_near(found_EL, np.stack([each[name] for each in expected]), name)
    earned = [truth.leap_rewards(mj_model, now, (still, still, still)) for now in moments]
    assert set(rewards) == set(earned[0])
    for name, found_E in rewards.items():
        assert_near(found_E, np.array([each[name] for each in earned]), name)
    assert rewards["reached"].tolist() == [0.0] * 6 + [100.0, 0.0]
    assert rewards["dropped"].tolist() == [0.0] * 7 + [-5.0]


def test_steps_reward_actions_and_move_goals_as_the_formulas_say(env, mj_model):
    root = env.reset()
    inner, random = env.base_env, np.random.default_rng(1)
    world = inner.world
    actions = [np.zeros((COUNT, 16)) for _ in range(2)]
    target_EL, turn_E3 = world.ctrl_EL.double().numpy().copy(), np.zeros((COUNT, 3))
    low, high = mj_model.actuator_ctrlrange.T
    num_reached = 0
    for step in range(6):
        if step == 2:
            # Three cubes take the orientations of their goals, in the air, where nothing turns them.
            world.qpos_EL[:3, 18] = 0.3
            world.qpos_EL[:3, 19:] = root["command", "goal"][:3]
            world.qvel_EL[:3, 16:] = 0.0
        goal_E4 = root["command", "goal"].double().numpy().copy()
        actions.insert(0, random.uniform(-1.0, 1.0, size=(COUNT, 16)))
        sums_ER = inner.reward_manager.episode_sums_ER.clone()
        stepped, root = env.step_and_maybe_reset(
            root.set("action", torch.tensor(actions[0], dtype=torch.float32))
        )
        assert not stepped["next", "done"].any()
        target_EL = np.clip(target_EL + 0.5 * actions[0], low, high)
        assert_near(world.ctrl_EL, target_EL, "targets")
        earned = dict(
            zip(
                inner.reward_manager.names,
                (inner.reward_manager.episode_sums_ER - sums_ER).T,
                strict=True,
            )
        )
        for row in range(COUNT):
            now = truth.Moment(
                qpos=world.qpos_EL[row].double().numpy(),
                qvel=world.qvel_EL[row].double().numpy(),
                ctrl=target_EL[row],
                wanted=goal_E4[row],
                sensordata=world.sensordata_EL[row].double().numpy(),
                actuator_force=world.actuator_force_EL[row].double().numpy(),
            )
            expected = truth.leap_rewards(
                mj_model, now, tuple(action_EL[row] for action_EL in actions[:3])
            )
            for name, value in expected.items():
                assert abs(float(earned[name][row]) - value) < 2e-5 * (1.0 + abs(value)), (
                    name,
                    row,
                )
            new_goal = root["command", "goal"][row].double().numpy()
            if expected["reached"]:
                num_reached += 1
                # For a rotation of less than pi the rotation vector points along the velocity.
                turn_E3[row] = 20.0 * rotation_vector(goal_E4[row], new_goal)
                assert (turn_E3[row] > 2.0 - 1e-3).all() and (turn_E3[row] < 10.0 + 1e-3).all()
            else:
                turn_E3[row] *= 0.8
                wanted = truth.turned(goal_E4[row], turn_E3[row], 0.05)
                np.testing.assert_allclose(new_goal, wanted, atol=2e-5)
    assert num_reached >= 3
    shown_E4 = world.view("mocap_quat")[:, 0]
    assert torch.equal(shown_E4, root["command", "goal"])
    assert inner.metric_manager.reduced_EM[:, 0].sum() == num_reached


def rotation_vector(start, end):
    """What turns one orientation into the other, about the axes of the first."""
    turn = truth.times(truth.inverse(start), end)
    turn = turn if turn[0] >= 0 else -turn
    size = np.linalg.norm(turn[1:])
    return 2.0 * np.arctan2(size, turn[0]) * turn[1:] / size


def test_rows_that_reset_leave_the_goals_of_the_others_alone(env):
    root = env.reset()
    for _ in range(3):
        _, root = env.step_and_maybe_reset(env.rand_action(root))
    inner = env.base_env
    before = {
        name: value.clone()
        for name, value in inner.state_dict().items()
        if value.shape[:1] == (COUNT,)
    }
    env.reset(env_ids=[1, 4])
    after, others = inner.state_dict(), [0, 2, 3, 5, 6, 7]
    for name, value in before.items():
        assert torch.equal(after[name][others], value[others]), name


def test_it_has_the_sizes_and_times_of_playground(env, mj_model):
    inner = env.base_env
    # Playground's: 57, and 128 less its 12 zeros of perturbations that are off.
    assert env.observation_spec["actor"].shape[-1] == 57
    assert sum(env.observation_spec[group].shape[-1] for group in ("actor", "critic")) == 128 - 12
    assert env.full_action_spec["action"].shape[-1] == 16
    assert (inner.step_dt, inner.physics_dt) == pytest.approx((0.05, 0.01))
    assert inner.max_episode_length == 1000
    ours = inner.world.mj_model
    for field in (
        "body_mass",
        "dof_damping",
        "dof_frictionloss",
        "actuator_gainprm",
        "geom_friction",
        "qpos0",
    ):
        np.testing.assert_allclose(
            getattr(ours, field), getattr(mj_model, field), atol=1e-9, err_msg=field
        )
    assert ours.opt.ccd_iterations == 10 and ours.opt.integrator == mj_model.opt.integrator
    goal = mj_model.key_mpos[0]
    np.testing.assert_allclose(
        inner.world.view("mocap_pos")[:, 0], np.tile(goal, (COUNT, 1)), atol=1e-6
    )


def test_episodes_end_where_the_cube_falls(env):
    env.reset()
    inner = env.base_env
    inner.world.qpos_EL[:, 18] = torch.tensor([-0.051] * 2 + [-0.049] * 6)
    inner.world.refresh()
    inner.driver.refreshed()
    terminated_E, _ = inner.termination_manager.step(torch.ones(COUNT, dtype=torch.bool))
    assert terminated_E.tolist() == [True] * 2 + [False] * 6


def test_hands_cubes_and_goals_start_as_playground_draws_them(mj_model):
    env = envs.make("leap_cube_reorient", num_envs=512, seed=3)
    world = env.base_env.world
    goal_E4 = env.reset()["command", "goal"].clone()
    first_EL, home = (
        world.qpos_EL.clone(),
        torch.tensor(mj_model.key("home").qpos, dtype=torch.float32),
    )
    low, high = torch.tensor(mj_model.actuator_ctrlrange, dtype=torch.float32).T
    hand_EL = first_EL[:, :16]
    assert ((hand_EL >= low - 1e-6) & (hand_EL <= high + 1e-6)).all()
    assert torch.equal(world.ctrl_EL, hand_EL) and not world.qvel_EL.any()
    spread_EL = (hand_EL - home[:16]) / 0.1
    assert abs(float(spread_EL.mean())) < 0.05 and abs(float(spread_EL.std()) - 1.0) < 0.05
    offset_E3 = first_EL[:, 16:19] - torch.tensor([0.1, 0.0, 0.05])
    assert (offset_E3.abs() <= 0.0100001).all()
    assert (offset_E3.std(dim=0) - 0.02 * 0.2887).abs().max() < 5e-4
    for quat_E4 in (first_EL[:, 19:], goal_E4):
        torch.testing.assert_close(quat_E4.norm(dim=-1), torch.ones(512))
        # Uniform orientations: mean of each number 0, of its square 1/4 (standard error 0.01).
        assert quat_E4.mean(dim=0).abs().max() < 0.1
        assert (quat_E4.square().mean(dim=0) - 0.25).abs().max() < 0.05
    env.close()


def test_the_actor_reads_noise_of_playgrounds_size_and_the_critic_none(mj_model):
    env = envs.make("leap_cube_reorient", num_envs=512, seed=3)
    root = env.reset()
    clean = torch.cat([root["obs", name] for name in ACTOR], dim=-1)
    error_EL = root["actor"] - clean
    joint_EL, target_EL, offset_EL, turn_EL, action_EL = error_EL.split((16, 16, 3, 6, 16), dim=-1)
    for noise_EL, size in ((joint_EL, 0.05), (offset_EL, 0.02)):
        assert noise_EL.abs().max() <= size * 1.0001
        assert float(noise_EL.std()) == pytest.approx(size / 3**0.5, rel=0.05)
    assert float(turn_EL.std()) == pytest.approx(0.2, rel=0.05)
    assert not target_EL.any() and not action_EL.any()
    assert torch.equal(root["critic"], torch.cat([root["obs", name] for name in CRITIC], dim=-1))
    env.close()


ACTOR = ("joint_pos", "joint_target", "cube_offset", "cube_turn", "last_action")
CRITIC = ("joint_pos", "joint_vel", "fingertips", "cube_offset", "cube_turn", "cube_velocity")


def test_noise_on_a_quaternion_turns_by_as_much_as_the_actor_reads():
    """The derivation of the noise of `cube_turn`: 0.1 on each number of a quaternion is 0.2 rad about each axis."""
    random = np.random.default_rng(0)
    noisy = np.array([1.0, 0.0, 0.0, 0.0]) + 0.1 * random.normal(size=(20_000, 4))
    noisy /= np.linalg.norm(noisy, axis=-1, keepdims=True)
    half = np.arccos(noisy[:, :1])
    vectors = 2.0 * half * noisy[:, 1:] / np.sin(half)
    assert vectors.std(axis=0) == pytest.approx(0.2, rel=0.03)
