"""The env of Go1's task; its figures are compared in `test_velocity_figures`."""

import dataclasses

import pytest
import torch

from ksim_rl import envs
from ksim_rl.scene.names import NameResolver
from ksim_rl.scene.scene import build_spec
from tests.scene.robots.reference import loaded_spec, reference_figures

CFG = envs.task("go1_velocity_flat").cfg()
ROBOT = CFG.scene.robots["go1"]


@pytest.fixture
def figures():
    return reference_figures("unitree_go1")


def test_model_has_the_physics_of_the_task(figures):
    loaded_spec(ROBOT)
    spec = build_spec(CFG.scene)
    CFG.sim.apply_to(spec)
    model = spec.compile()
    assert model.opt.timestep == figures["physics"]["timestep"]
    assert model.opt.impratio == figures["physics"]["impratio"]
    resolver = NameResolver(model, torch.device("cpu"))
    assert [
        resolver.names("joint")[i] for i in resolver.ids("joint", ROBOT.joint_names)
    ] == figures["joint_names"]


@pytest.fixture(scope="module")
def env():
    loaded_spec(ROBOT)
    env = envs.make("go1_velocity_flat", num_envs=4, seed=3)
    yield env
    env.close()


def test_group_sizes_and_a_short_rollout(env, figures):
    for group, size in figures["obs_dims"].items():
        assert env.observation_spec[group].shape == (4, size)
    assert env.action_spec.shape == (4, len(figures["joint_names"]))
    rollout = env.rollout(6, break_when_any_done=False)
    assert (
        torch.isfinite(rollout["next", "critic"]).all()
        and torch.isfinite(rollout["next", "reward"]).all()
    )
    critic, bias = (
        rollout["obs", "joint_pos"],
        rollout["obs", "joint_pos_biased"] - rollout["obs", "joint_pos"],
    )
    assert critic.shape == (4, 6, 12)
    torch.testing.assert_close(bias, bias[:, :1].expand_as(bias), atol=1e-6, rtol=0)
    assert 0.0 < bias.abs().max() <= 0.015 + 1e-6


def test_zero_action_holds_the_stance(env):
    base = env.base_env
    env.set_seed(0)
    td = env.reset()
    for _ in range(25):
        td["action"] = torch.zeros(4, 12)
        td = env.step(td)["next"].exclude("reward")
    assert not td["done"].any()
    height = base.view.root_pos_EL[:, 2]
    assert (height > 0.2).all() and (height < 0.33).all()
    contact = base.view.contact("feet_ground_contact")
    assert contact.found_EN.sum() >= 12
    weight = 9.81 * base.world.mj_model.body_mass.sum()
    assert (-contact.force_EN3[..., 2].sum(-1) > 0.3 * weight).all()


def test_config_survives_the_trip_through_yaml():
    tree = envs.to_tree(CFG, envs.ManagerBasedRlEnvCfg)
    assert envs.from_tree(envs.ManagerBasedRlEnvCfg, tree) == CFG
    changed = envs.make_cfg("go1_velocity_flat", ["task.rewards.upright.weight=0.5"])
    assert changed.rewards["upright"] == dataclasses.replace(CFG.rewards["upright"], weight=0.5)
    assert changed.events == CFG.events
