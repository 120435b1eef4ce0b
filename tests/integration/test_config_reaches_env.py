"""Every field of the env's config, set by an override of `envs.make`, changes what the env does."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.config import plugins
from ksim_rl.physics import SimCfg
from ksim_rl.scene.rendering import rendering

DT = 0.01
E = 2


def made(
    *overrides: str, seed: int | None = 0, render_mode: str | None = None
) -> envs.MaskedTransformedEnv:
    return envs.make(
        "cartpole_balance", num_envs=E, seed=seed, overrides=overrides, render_mode=render_mode
    )


def rolled_out(env, steps=1, action=0.5):
    """Roll out with a constant action from the env's own seed, through the ends of episodes."""
    return env.rollout(
        steps, lambda td: td.set("action", torch.full((E, 1), action)), break_when_any_done=False
    )


@pytest.fixture
def own_terms(monkeypatch):
    """Let configs build the terms of the tests."""
    monkeypatch.setattr(plugins, "_allowed", set(plugins._allowed))
    envs.allow_package("tests")


def test_every_field_has_a_test():
    tested = [name.removeprefix("test_") for name in globals() if name.startswith("test_")]
    for field in dataclasses.fields(envs.ManagerBasedRlEnvCfg):
        assert any(name.startswith(field.name) for name in tested), field.name


def test_decimation():
    once, twice = rolled_out(made(), 2), rolled_out(made("task.decimation=2"), 1)
    assert torch.equal(
        twice["next", "obs", "position"][:, 0], once["next", "obs", "position"][:, 1]
    )
    assert made("task.decimation=2").base_env.step_dt == pytest.approx(2 * DT)


def test_scene_num_envs():
    assert made().batch_size == torch.Size([E])
    assert made("task.scene.num_envs=9").batch_size == torch.Size([E]), (
        "the argument of `make` has the last word"
    )


def test_scene_robots():
    # Several robots have prefixes.
    with pytest.raises(ValueError, match="did you mean 'other/slider'"):
        made("+task.scene.robots.other={_target_: ksim_rl.scene.robots.Cartpole}")


def test_scene_terrain_and_sensors():
    env = made(
        "task.scene.terrain={_target_: ksim_rl.scene.terrains.PlaneTerrain, friction: [0.5, 0.1, 0.2]}",
        "+task.scene.sensors.touch={_target_: ksim_rl.scene.sensors.contact.ContactSensor, geoms: [pole], "
        "against: terrain}",
    ).base_env
    assert env.world.mj_model.geom("terrain").friction.tolist() == [0.5, 0.1, 0.2]
    assert env.view.contact("touch").found_EN.shape == (E, 1)


def test_scene_soft_joint_pos_limit_factor():
    env = made("task.scene.soft_joint_pos_limit_factor=0.5").base_env
    torch.testing.assert_close(env.view.soft_joint_pos_limits_L2[0], torch.tensor([-0.9, 0.9]))


def test_observations_of_one_group_leave_the_other_alone():
    velocity = "task.observations.actor.terms.velocity"
    noise = "{_target_: ksim_rl.transforms.noise.cfg.ConstantNoise, value: 0.25}"
    rollout_ET = rolled_out(made(f"{velocity}.scale=2.0", f"{velocity}.noise={noise}"), 3)
    actor, critic = rollout_ET["actor"], rollout_ET["critic"]
    torch.testing.assert_close(actor[..., 3:], 2.0 * (critic[..., 3:] + 0.25))
    assert torch.equal(actor[..., :3], critic[..., :3])


def test_observations_clip_delay_history_and_keep_terms():
    terms = "task.observations.actor.terms"
    env = made(
        f"{terms}.position.history=2",
        f"{terms}.velocity.delay={{min_lag: 1, max_lag: 1}}",
        f"{terms}.velocity.clip=[-0.05, null]",
        "task.observations.actor.keep_terms=true",
    )
    rollout_ET = rolled_out(env, 4, action=-1.0)
    clean, actor = rollout_ET["obs"], rollout_ET["actor"]
    assert actor.shape[-1] == 2 * 3 + 2
    assert torch.equal(actor[:, 1:, :3], clean["position"][:, :-1]), "oldest first"
    assert torch.equal(actor[:, 1:, 6:], clean["velocity"][:, :-1].clamp(min=-0.05))
    assert torch.equal(rollout_ET["actor_terms", "velocity"], actor[..., 6:])


def test_observations_enable_noise():
    noise = "{_target_: ksim_rl.transforms.noise.cfg.ConstantNoise, value: 5.0}"
    given = f"task.observations.actor.terms.velocity.noise={noise}"
    silent = rolled_out(made(given, "task.observations.actor.enable_noise=false"))
    assert torch.equal(silent["actor"], silent["critic"])


def test_actions():
    env = made("task.actions.force.scale=0.5")
    rolled_out(env, action=0.5)
    assert env.base_env.world.ctrl_EL.tolist() == [[0.25]] * E


def test_events():
    default, far = made().reset(), made("task.events.reset.cart_range=1.7").reset()
    torch.testing.assert_close(
        far["obs", "position"][:, 0] / default["obs", "position"][:, 0], torch.full((E,), 17.0)
    )
    for nothing_drawn in ("task.events=null", "~task.events.reset"):
        assert made(nothing_drawn).reset()["obs", "velocity"].eq(0.0).all()


def test_seed():
    def start(*overrides, seed=None):
        env = made(*overrides, seed=seed)
        return env.reset()["actor"].clone(), env.base_env.cfg.seed

    first, used = start("task.seed=5")
    assert used == 5
    assert torch.equal(start(seed=5)[0], first)
    assert torch.equal(start("task.seed=6", seed=5)[0], first), (
        "the argument of `make` has the last word"
    )
    assert not torch.equal(start("task.seed=6")[0], first)
    drawn, again = start()[1], start()[1]
    assert drawn >= 0 and again >= 0 and drawn != again, "drawn again, and stored"


SIM = {
    "timestep": "0.002",
    "integrator": "euler",
    "solver": "cg",
    "cone": "elliptic",
    "impratio": "3.0",
    "tolerance": "0.125",
    "iterations": "3",
    "ls_iterations": "4",
    "ccd_iterations": "7",
    "njmax": "24",
    "nconmax": "16",
    "require_graphs": "true",
}


def test_sim_fields_reach_the_physics():
    # The others have tests of their own, in tests/envs/test_nan_guard.py and tests/physics.
    assert {*SIM, "nan_guard", "one_kernel_solver", "one_kernel_dynamics", "engine"} == {
        field.name for field in dataclasses.fields(SimCfg)
    }
    world = made(*(f"task.sim.{name}={value}" for name, value in SIM.items())).base_env.world
    option, warp_option = world.mj_model.opt, world.warp_model.opt
    assert (option.timestep, option.impratio, option.ccd_iterations) == (0.002, 3.0, 7)
    named = (
        mujoco.mjtIntegrator.mjINT_EULER,
        mujoco.mjtSolver.mjSOL_CG,
        mujoco.mjtCone.mjCONE_ELLIPTIC,
    )
    assert (option.integrator, option.solver, option.cone) == named
    assert (int(warp_option.integrator), int(warp_option.solver), int(warp_option.cone)) == named
    assert (warp_option.iterations, warp_option.ls_iterations, warp_option.ccd_iterations) == (
        3,
        4,
        7,
    )
    assert warp_option.timestep.numpy().tolist() == pytest.approx([0.002])
    assert warp_option.tolerance.numpy().tolist() == [0.125]
    assert (world.warp_data_E.njmax, world.warp_data_E.naconmax) == (24, 16 * E)
    assert world.sim.require_graphs


def test_sim_timestep_changes_the_motion():
    env = made("task.sim.timestep=0.002", "task.decimation=5")
    assert (env.base_env.physics_dt, env.base_env.step_dt) == pytest.approx((0.002, DT))
    fine, coarse = rolled_out(env, 10)["next", "critic"], rolled_out(made(), 10)["next", "critic"]
    torch.testing.assert_close(fine, coarse, atol=0.05, rtol=0)
    assert not torch.equal(fine, coarse)


class FakeRenderer:
    """Notes what a renderer is asked for, without OpenGL."""

    made: "list[FakeRenderer]" = []

    def __init__(self, model, height, width, max_geom):
        self.size, self.scene = (height, width), mujoco.MjvScene(model, maxgeom=max_geom)
        FakeRenderer.made.append(self)

    def update_scene(self, data, camera, scene_option):
        self.qpos, self.camera = data.qpos.copy(), camera

    def render(self):
        return np.zeros((*self.size, 3), np.uint8)

    def close(self):
        pass


@pytest.fixture
def renderer(monkeypatch):
    """Return what the last env's picture was made with."""
    monkeypatch.setattr(rendering, "choose_gl_platform", lambda: "none")
    monkeypatch.setattr(mujoco, "Renderer", FakeRenderer)

    def drawn(*overrides):
        env = made(*overrides, render_mode="rgb_array")
        env.reset()
        env.base_env.world.qpos_EL[:, 0] = torch.tensor([0.5, -1.0])
        assert env.base_env.render().shape[:2] == FakeRenderer.made[-1].size
        return FakeRenderer.made[-1]

    return drawn


def test_viewer_camera_and_size(renderer):
    fields = {"distance": 7.0, "elevation": -33.0, "azimuth": 12.0, "width": 80, "height": 60}
    given = [f"task.viewer.{name}={value}" for name, value in fields.items()]
    drawn = renderer(*given, "task.viewer.body=null", "task.viewer.lookat=[1.0, 2.0, 3.0]")
    assert drawn.size == (60, 80)
    assert (drawn.camera.distance, drawn.camera.elevation, drawn.camera.azimuth) == (
        7.0,
        -33.0,
        12.0,
    )
    assert list(drawn.camera.lookat) == [1.0, 2.0, 3.0]


def test_viewer_body_and_env_index(renderer):
    assert renderer().qpos[0] == 0.5 and renderer().camera.lookat[0] == 0.5
    second = renderer("task.viewer.env_index=1", "task.viewer.body=pole")
    assert second.qpos[0] == -1.0 and list(second.camera.lookat) == [-1.0, 0.0, 1.0]


def test_viewer_num_envs_and_scene_spacing(renderer):
    assert renderer().scene.ngeom == 0
    second = renderer("task.viewer.num_envs=2", "task.scene.spacing=4.0").scene
    # Cart and pole of env 1, which stands at x = -1, drawn one spacing further.
    assert second.ngeom == 2 and float(second.geoms[0].pos[0]) == pytest.approx(3.0)


def test_episode_length_s():
    truncated = rolled_out(made(f"task.episode_length_s={4 * DT}"), 9)["next", "truncated"][0, :, 0]
    assert truncated.nonzero().flatten().tolist() == [3, 7]


def test_rewards():
    default, half = rolled_out(made(), 3), rolled_out(made("task.rewards.balance.weight=0.5"), 3)
    torch.testing.assert_close(half["next", "reward"], 0.5 * default["next", "reward"])
    assert rolled_out(made("~task.rewards.balance"))["next", "reward"].eq(0.0).all()


def test_terminations():
    ended = rolled_out(made("task.terminations.fallen.limit=0.0001"), 3)["next", "terminated"]
    assert ended.all() and not rolled_out(made(), 3)["next", "terminated"].any()
    falling = rolled_out(made("~task.terminations.fallen"), 120, action=1.0)
    assert (
        not falling["next", "terminated"].any() and falling["obs", "position"][..., 1].min() < 0.0
    )


def test_commands(own_terms):
    target = "{_target_: tests.envs.probe_env.Target, resampling_time_range_s: [0.01, 0.01]}"
    rollout_ET = rolled_out(made(f"+task.commands.target={target}"), 3)
    assert len(rollout_ET["command", "target"].unique()) == 3 * E, (
        "a command of its own at each step"
    )
    assert "command" not in rolled_out(made()).keys()


def test_curriculum(own_terms):
    ramp = "tests.envs.managers.test_curriculum_manager.WeightByEpisodes"
    env = made(
        f"+task.curriculum.ramp={{_target_: {ramp}, reward: balance}}",
        f"task.episode_length_s={2 * DT}",
    )
    reward = rolled_out(env, 4)["next", "reward"]
    assert reward[:, :2].eq(0.0).all() and (reward[:, 2:] > 1.0).all(), (
        "its weight is 2 in the second episode"
    )
    assert list(env.base_env.curriculum_levels()) == ["ramp"]


def test_metrics():
    acceleration = "{_target_: ksim_rl.mdp.ActionAcceleration, reduce: max}"
    env = made(f"+task.metrics.jolt={acceleration}", f"task.episode_length_s={2 * DT}")
    rolled_out(env, 2, action=0.5)
    assert float(env.base_env.episode_log()["metric/jolt"]) == 0.5 * E


def test_transforms_delay_the_actions_by_exactly_their_lag():
    lag = "+task.transforms.lag={_target_: ksim_rl.envs.transforms.ActionDelay, delay: {min_lag: 1, max_lag: 2}}"
    env = made(lag, "task.transforms.lag.delay.min_lag=2")
    assert "lag" in env.explain()
    td, taken = env.reset(), []
    for step in range(1, 6):
        td = env.step_and_maybe_reset(td.set("action", torch.full((E, 1), step / 10)))[1]
        taken.append(env.base_env.view.action_EL.mean())
    torch.testing.assert_close(torch.stack(taken), torch.tensor([0.0, 0.0, 0.1, 0.2, 0.3]))


def test_is_finite_horizon():
    env = made("task.is_finite_horizon=true", f"task.episode_length_s={2 * DT}")
    next_ET = rolled_out(env, 2)["next"]
    assert next_ET["terminated"][:, 1].all() and not next_ET["truncated"].any()


def test_scale_rewards_by_dt():
    default, scaled = rolled_out(made(), 3), rolled_out(made("task.scale_rewards_by_dt=true"), 3)
    torch.testing.assert_close(scaled["next", "reward"], DT * default["next", "reward"])
