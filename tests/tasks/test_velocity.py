"""Velocity and get-up tasks: a stance that holds without a policy, sizes, and rewards that rank states rightly."""

import dataclasses
from typing import Any

import pytest
import torch

from ksim_rl import conf, envs
from ksim_rl.envs import ManagerBasedRlEnv, ViewerCfg
from ksim_rl.scene.robots.own_robots import Humanoid
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.tasks import velocity
from ksim_rl.trainers import build
from tests.scene.robots.reference import loaded_spec

OWN = ("quadruped_velocity_flat", "humanoid_velocity_flat")
# Go1 has a file of its own.
MENAGERIE = ("go2_velocity_flat", "t1_velocity_flat", "g1_velocity_flat")
GET_UP = ("quadruped_get_up", "humanoid_get_up")
MENAGERIE_GET_UP = ("go1_get_up", "g1_get_up", "t1_get_up")
# On flat ground nothing else pushes or pulls: what stands here is held by the default targets alone.
CALM = ("~task.events.push_robot",)


UPRIGHT_E4 = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1)


def slow(names):
    return [pytest.param(name, marks=pytest.mark.full) for name in names]


@pytest.fixture(scope="module", params=[*OWN, *slow(MENAGERIE)])
def env(request):
    (robot,) = envs.task(request.param).cfg().scene.robots.values()
    loaded_spec(robot)
    env = envs.make(request.param, num_envs=3, seed=3, overrides=CALM)
    yield env
    env.close()


def test_zero_action_stands_for_two_seconds(env):
    base = env.base_env
    (robot,) = base.cfg.scene.robots.values()
    # Whose reference gains are too soft to stand on for longer.
    seconds = 0.7 if robot.name == "g1" else 2.0
    td = env.reset()
    zero = torch.zeros(env.action_spec.shape)
    for _ in range(round(seconds / base.step_dt)):
        td = env.step(td.set("action", zero))["next"].exclude("reward")
        assert not td["done"].any()
    view = base.view
    assert (view.root_pos_EL[:, 2] > 0.75 * view.default_qpos_L[2]).all()
    assert (view.projected_gravity_EL[:, 2] < -0.97).all()
    contact = view.contact("feet_ground_contact")
    assert (contact.found_EN.sum(-1) == len(robot.foot_sites)).all()
    carried_E = -contact.force_EN3[..., 2].sum(-1)
    weight = 9.81 * float(base.world.mj_model.body_subtreemass[1])
    torch.testing.assert_close(carried_E, torch.full_like(carried_E, weight), rtol=0.3, atol=0.0)


def test_groups_and_rewards_of_random_actions(env):
    joints, feet = (
        env.action_spec.shape[-1],
        env.base_env.view.contact("feet_ground_contact").found_EN.shape[-1],
    )
    assert env.observation_spec["actor"].shape == (3, 3 * joints + 12)
    assert env.observation_spec["critic"].shape == (3, 3 * joints + 12 + 6 * feet)
    rollout = env.rollout(10, break_when_any_done=False)
    assert torch.isfinite(rollout["next", "critic"]).all()
    reward = rollout["next", "reward"]
    assert torch.isfinite(reward).all() and reward.abs().max() < 1.0


@pytest.fixture(scope="module", params=[GET_UP[0], *slow((*GET_UP[1:], *MENAGERIE_GET_UP))])
def fallen(request):
    (robot,) = envs.task(request.param).cfg().scene.robots.values()
    loaded_spec(robot)
    env = envs.make(request.param, num_envs=8, seed=1)
    yield env
    env.close()


def test_get_up_starts_anywhere_and_rewards_standing(fallen):
    base, view = fallen.base_env, fallen.base_env.view
    roots = [fallen.reset() for _ in range(4)]
    up = torch.cat([-root["obs", "projected_gravity"][:, 2] for root in roots])
    assert up.min() < -0.7 and up.max() > 0.7 and up.std() > 0.4
    # Nothing starts deep in the ground.
    assert min(root["obs", "imu_and_foot_height"].min() for root in roots) > -0.03
    td, zero = roots[-1], torch.zeros(fallen.action_spec.shape)
    for _ in range(75):
        td = fallen.step(td.set("action", zero))["next"].exclude("reward")
        assert not td["done"].any()
    height_E = view.root_pos_EL[:, 2]
    tall_E = (-view.projected_gravity_EL[:, 2] > 0.97) & (
        height_E > 0.9 * base.cfg.rewards["height"].standing_height
    )
    assert not tall_E.all()  # holding the default pose does not get up from everywhere
    with base.driver.scope("test"):
        standing_E = base.cfg.rewards["standing"](view)
        stands_E = base.cfg.metrics["stands"](view)
    assert (standing_E >= 0).all() and (standing_E <= 1).all()
    # At three quarters of the height at most 0.75 squared is left.
    low_E = height_E < 0.75 * base.cfg.rewards["height"].standing_height
    assert low_E.any() and (standing_E[low_E] < 0.6).all()
    assert not stands_E[
        ~tall_E & (height_E < 0.6 * base.cfg.rewards["height"].standing_height)
    ].any()


def test_get_up_rates_the_stance_highest(fallen):
    """Put robots into the stance, beside it and upside down; the terms must rank them so."""
    view, base = fallen.base_env.view, fallen.base_env
    everyone_E = torch.ones(8, dtype=torch.bool)
    pos_E3 = view.default_qpos_L[:3].repeat(8, 1)
    quat_E4 = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(8, 1)
    quat_E4[1] = torch.tensor([0.7071068, 0.7071068, 0.0, 0.0])
    quat_E4[2] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    pos_E3[1:3, 2] *= 0.4
    view.write_root_pose(everyone_E, pos_E3, quat_E4)
    view.write_root_velocity(everyone_E, torch.zeros(8, 3), torch.zeros(8, 3))
    view.joints().write_pos(everyone_E, view.default_joint_pos_EL)
    speed_EL = torch.zeros_like(view.default_joint_pos_EL)
    speed_EL[3] = 3.0
    view.joints().write_vel(everyone_E, speed_EL)
    view.world.refresh()
    base.driver.refreshed()
    with base.driver.scope("test"):
        reward = {
            name: term(view)
            for name, term in base.cfg.rewards.items()
            if name in ("upright", "height", "standing")
        }
        stands_E = base.cfg.metrics["stands"](view)
    torch.testing.assert_close(
        reward["upright"][:3], torch.tensor([1.0, 0.5, 0.0]), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(reward["height"][:2], torch.tensor([1.0, 0.4]), atol=0.03, rtol=0)
    assert (
        reward["standing"][0] > 0.99
        and reward["standing"][1] < 0.1
        and reward["standing"][2] == 0.0
    )
    assert reward["standing"][3] < 0.2  # it shakes
    assert stands_E[:4].tolist() == [1.0, 0.0, 0.0, 1.0]


def test_who_stands_later_than_within_3_s_has_not_stood_soon():
    soon = envs.task("go1_get_up").cfg().metrics["stood_soon"]
    env = envs.make("quadruped_get_up", num_envs=2, seed=1, overrides=["task.sim.engine=c"])
    base = env.base_env
    view = base.view
    everyone_E = torch.ones(2, dtype=torch.bool)
    env.reset()
    view.write_root_pose(everyone_E, view.default_qpos_L[:3].repeat(2, 1), UPRIGHT_E4)
    base.driver.refreshed()
    found = []
    for steps in (25, 26, 150, 151):
        base.driver.episode_step_E.fill_(steps)
        with base.driver.scope("test"):
            found.append(soon(view).tolist())
    # 50 steps are a second, and in the first half of it a robot may be in the air.
    assert found == [[0.0, 0.0], [1.0, 1.0], [1.0, 1.0], [0.0, 0.0]]
    assert soon.reduce == "max"
    env.close()


def test_actions_of_the_delayed_quadruped_arrive_up_to_two_steps_late():
    env = envs.make("quadruped_velocity_delayed", num_envs=64, seed=3, overrides=CALM)
    td, lags = env.reset(), []
    for step in range(6):
        action = torch.full(env.action_spec.shape, 0.01 * step)
        td = env.step(td.set("action", action))["next"].exclude("reward")
        lags.append((step - 100.0 * env.base_env.view.action_EL[:, 0]).round())
    assert set(lags[-1].tolist()) == {0.0, 1.0, 2.0}
    assert torch.equal(lags[-1], lags[-2]), "a lag stays for the episode"
    env.close()


def test_feet_of_several_geoms_are_refused_before_anything_is_built():
    robot = Humanoid()
    parts = {
        "sim": velocity.sim(),
        "viewer": ViewerCfg(),
        "rewards": {},
        "events": {},
        "observations": {},
    }
    with pytest.raises(
        ValueError,
        match=r"feet: 4 geom elements .* for 2 foot_sites: .*ContactSensor\(bodies=...\)",
    ):
        velocity.velocity_cfg(robot, feet=ContactSensor(geoms=robot.foot_geoms), **parts)
    for feet in (ContactSensor(bodies=robot.foot_bodies), ContactSensor(geoms=(".*_foot_inner",))):
        sensors = velocity.velocity_cfg(robot, feet=feet, **parts).scene.sensors
        assert sensors["feet_ground_contact"] == feet


def test_commands_become_faster_by_stages():
    cfg = envs.task("quadruped_velocity_flat").cfg()
    scene = dataclasses.replace(cfg.scene, num_envs=3)
    base = ManagerBasedRlEnv(dataclasses.replace(cfg, scene=scene), device="cpu")
    base.reset()
    for steps, expected in (
        (119_999, ((-1, 1), (-0.5, 0.5))),
        (120_000, ((-1.5, 2), (-0.7, 0.7))),
        (240_000, ((-2, 3), (-0.7, 0.7))),
    ):
        base.driver.step_count.fill_(steps)
        base.reset()
        ranges = base.view.command_ranges["twist"]
        assert tuple(ranges["lin_vel_x"].tolist()) == pytest.approx(expected[0])
        assert tuple(ranges["ang_vel_z"].tolist()) == pytest.approx(expected[1])
        assert ranges["lin_vel_y"].tolist() == [-1.0, 1.0]
    base.close()


@pytest.mark.full
def test_a_humanoid_that_gets_up_is_not_thrown_about_by_its_first_policy():
    """Its joints move at up to 24 rad/s in 99 % of what they do; with an output gain of 1 that were 72."""
    words = "device=cpu logger=none num_envs=128 data.num_env_states_per_minibatch=768 trainer.eval_episodes=0"
    trainer = build(conf.compose(["task=humanoid_get_up", *words.split()]))
    joints = trainer.collector.env.action_spec.shape[-1]
    rollout_ET: Any = trainer.collector.collect()
    speeds = rollout_ET["actor"][..., -2 * joints : -joints].abs()
    trainer.collector.env.close()
    assert 10.0 < speeds.flatten().quantile(0.99) < 36.0
