"""Commands, events, terminations, metrics and curricula together in an env: no waiting, no mixing of rows, no loss."""

import numpy as np
import pytest
import torch

from ksim_rl.envs import ManagerBasedRlEnv, MjcfRobot, ObservationGroupCfg, ObservationTermCfg, SceneCfg, mdp
from ksim_rl.envs.sensors import ContactSensor
from ksim_rl.testing import count_syncs
from tests.envs.probe_env import DT, puck_cfg

HOPPER = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="terrain"><geom name="terrain" type="plane" size="0 0 0.01"/></body>
    <body name="trunk" pos="0 0 0.5">
      <freejoint name="root"/>
      <geom name="trunk" type="box" size="0.1 0.1 0.05" mass="2"/>
      <site name="trunk"/>
      <body name="foot" pos="0 0 -0.2">
        <joint name="knee" axis="0 1 0" range="-1 1" limited="true"/>
        <geom name="foot" type="sphere" size="0.05" mass="0.2"/>
        <site name="foot"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="knee" joint="knee"/></actuator>
</mujoco>
"""
E = 6
OFTEN = (2 * DT, 6 * DT)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """The trunk sinks a little."""
    qpos = np.tile([0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0, 0.1], (20, 1))
    qpos[:, 2] -= 0.01 * np.arange(20)
    file = tmp_path_factory.mktemp("clips") / "sink.npz"
    np.savez(file, fps=50.0, qpos=qpos, qvel=np.zeros((20, 7)))
    return str(file)


def made(clip, *, curricula=True):
    touch = {"touch": ContactSensor(geoms=("trunk", "foot"))}
    twist = mdp.UniformVelocityCommand(
        resampling_time_range_s=OFTEN,
        lin_vel_x=(-1.0, 1.0),
        lin_vel_y=(-1.0, 1.0),
        ang_vel_z=(-1.0, 1.0),
        rel_heading_envs=0.5,
    )
    pushed = dict.fromkeys(("x", "y", "z", "roll"), (-20.0, 20.0))
    cfg = puck_cfg(
        num_envs=E,
        limit=None,
        scene=SceneCfg(robots={"hopper": MjcfRobot(source=HOPPER)}, sensors=touch, num_envs=E),
        observations={
            "actor": ObservationGroupCfg(
                terms={
                    "pos": ObservationTermCfg(term=mdp.RootPos()),
                    "vel": ObservationTermCfg(term=mdp.RootLinVel()),
                }
            )
        },
        commands={
            "twist": twist,
            "height": mdp.BaseHeightCommand(resampling_time_range_s=OFTEN, height=(0.2, 0.4)),
            "joints": mdp.JointPositionCommand(
                resampling_time_range_s=OFTEN, joints=".*", offset=(-1.0, 1.0)
            ),
            "reach": mdp.CartesianCommand(
                resampling_time_range_s=OFTEN, position={"x": (0.0, 1.0)}, orientation={"yaw": (0.0, 1.0)}
            ),
            "start": mdp.StartPoseCommand(),
            "gait": mdp.SinusoidalGaitCommand(
                frequency=(1.0, 3.0), offsets=(0.0, 0.5), resampling_time_range_s=OFTEN
            ),
            "stick": mdp.JoystickCommand(axes={"vx": (-1.0, 1.0)}),
        },
        events={
            "motion": mdp.ResetToMotion(file=clip),
            "height": mdp.ResetHeight(height_range=(0.3, 0.5)),
            "heading": mdp.ResetHeading(),
            "joints": mdp.ResetJointsByScale(position_scale=(0.5, 1.5), velocity_range=(-1.0, 1.0)),
            "push": mdp.PushByForce(
                body="trunk", wrench_range=pushed, duration_s=(DT, 4 * DT), interval_range_s=OFTEN
            ),
            "jump": mdp.Jump(height_range=(0.0, 0.1), interval_range_s=OFTEN),
        },
        rewards={"upright": mdp.Upright(std=0.5), "alive": mdp.Alive(weight=0.0)},
        terminations={
            "time_out": mdp.TimeOut(),
            "low": mdp.RootHeightBelow(minimum_height=0.1),
            "far": mdp.FarFromOrigin(distance=0.3),
            "fast": mdp.RootVelocityAbove(linear=5.0, angular=50.0),
            "joint_fast": mdp.JointVelocityAbove(limit=60.0),
            "joint_out": mdp.JointLimitViolated(margin=0.5),
            "touched": mdp.IllegalContact(sensor="touch", threshold=500.0),
            "broken": mdp.NonFiniteState(),
        },
        metrics={
            "power": mdp.Power(),
            "cost": mdp.CostOfTransport(),
            "slip": mdp.FootSlipSpeed(sensor="touch", sites=("trunk", "foot")),
            "peak": mdp.PeakFootHeight(sites="foot"),
            "force": mdp.PeakContactForce(sensor="touch"),
            "success": mdp.Success(terminations=("time_out",)),
            "reached": mdp.TargetReached(command="reach", tolerance=0.2, body="trunk"),
            "error": mdp.LinearVelocityError(command="twist"),
        },
        curriculum={}
        if not curricula
        else {
            "level": mdp.EpisodeLengthLevel(raise_above=0.2, min_episodes=2),
            "weight": mdp.RewardWeightByLevel(reward="alive", start=0.0, end=1.0),
            "stage": mdp.RewardWeightByStage(reward="upright", stages={10: 2.0}),
            "ranges": mdp.CommandRangesByStage(command="twist", stages={12: {"lin_vel_x": (0.0, 2.0)}}),
            "heights": mdp.CommandRangesByLevel(
                command="height", start={"height": (0.3, 0.3)}, end={"height": (0.1, 0.5)}
            ),
        },
        episode_length_s=12 * DT,
    )
    return ManagerBasedRlEnv(cfg)


def action(step):
    return torch.sin(torch.arange(E) + 0.7 * step)[:, None]


def run(env, root_E, steps, start=0):
    states = []
    for step in range(start, start + steps):
        state_E, root_E = env.step_and_maybe_reset(root_E.clone().set("action", action(step)))
        states.append(state_E.clone())
    return states, root_E


def same(first, second):
    assert all(torch.equal(first[key], second[key]) for key in first.keys(True, True))


def test_steps_and_resets_never_make_the_host_wait_and_stay_finite(clip):
    env = made(clip)
    root_E = env.reset()
    with count_syncs() as syncs:
        states, _ = run(env, root_E, 30)
    assert syncs.total == 0, syncs.report()
    assert all(torch.isfinite(leaf).all() for state_E in states for leaf in state_E.values(True, True))
    log = env.episode_log()
    assert log["episodes"] >= E and log["termination/non_finite"] == log["termination/broken"] == 0
    levels = {**env.curriculum_levels(), **env.command_levels()}
    assert 0.0 < levels["level"] <= 1.0 and levels["weight"] == levels["heights"] == levels["level"]
    assert levels["stage"] == 2.0 and levels["ranges"] == 1.0 and levels["twist/lin_vel_x_high"] == 2.0


def test_stock_resets_give_the_same_rollout(clip):
    env, stock = made(clip), made(clip)
    states, _ = run(env, env.reset(), 30)
    root_E = stock.reset()
    for step, expected_E in enumerate(states):
        state_E = stock.step(root_E.clone().set("action", action(step)))
        same(state_E, expected_E)
        root_E = state_E["next"].exclude("reward")
        if root_E["done"].any():
            root_E = stock.reset(root_E.set("_reset", root_E["done"].clone()))


def test_a_partial_reset_leaves_the_other_rows_bit_identical(clip):
    # Curricula join the rows on purpose: what one has mastered is harder for all.
    env, twin = (made(clip, curricula=False) for _ in range(2))
    states = [run(each, each.reset(), 4)[1] for each in (env, twin)]
    rest = [0, 2, 4, 5]
    fresh_E = env.reset(states[0].clone(), env_ids=[1, 3])
    same(fresh_E[rest], states[1][rest])
    after, _ = run(env, fresh_E, 3, start=4)
    expected, _ = run(twin, states[1], 3, start=4)
    for first, second in zip(after, expected, strict=True):
        same(first[rest], second[rest])


def test_a_state_dict_continues_bit_exactly(clip):
    env, other = made(clip), made(clip)
    _, root_E = run(env, env.reset(), 9)
    env.command_manager.set("stick", [0.5])
    saved = env.state_dict()
    expected, _ = run(env, root_E, 12, start=9)
    other.seed(77)
    run(other, other.reset(), 3)
    other.load_state_dict(saved)
    actual, _ = run(other, root_E, 12, start=9)
    for first, second in zip(actual, expected, strict=True):
        same(first, second)
    assert actual[1]["command", "stick"].eq(0.5).all()
