"""An env in which commands, events, terminations, metrics and curricula of every kind run together."""

from pathlib import Path

import numpy as np

from ksim_rl import mdp
from ksim_rl.envs import (
    ManagerBasedRlEnv,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    SceneCfg,
)
from ksim_rl.scene.sensors import ContactSensor
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
NUM_ENVS = 6
OFTEN = (2 * DT, 6 * DT)


def write_clip(file: Path) -> str:
    """Write a motion in which the trunk sinks a little, and return the file's name."""
    qpos = np.tile([0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0, 0.1], (20, 1))
    qpos[:, 2] -= 0.01 * np.arange(20)
    np.savez(file, fps=50.0, qpos=qpos, qvel=np.zeros((20, 7)))
    return str(file)


def busy_env(
    clip: str, *, curricula: bool = True, device: str = "cpu", **fields
) -> ManagerBasedRlEnv:
    """Build an env of hoppers with every kind of command, event, termination, metric and curriculum."""
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
        num_envs=NUM_ENVS,
        limit=None,
        scene=SceneCfg(
            robots={"hopper": MjcfRobot(source=HOPPER)}, sensors=touch, num_envs=NUM_ENVS
        ),
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
                resampling_time_range_s=OFTEN,
                position={"x": (0.0, 1.0)},
                orientation={"yaw": (0.0, 1.0)},
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
            "ranges": mdp.CommandRangesByStage(
                command="twist", stages={12: {"lin_vel_x": (0.0, 2.0)}}
            ),
            "heights": mdp.CommandRangesByLevel(
                command="height", start={"height": (0.3, 0.3)}, end={"height": (0.1, 0.5)}
            ),
        },
        episode_length_s=12 * DT,
        **fields,
    )
    return ManagerBasedRlEnv(cfg, device)
