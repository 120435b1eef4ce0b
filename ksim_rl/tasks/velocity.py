"""The parts that all velocity tasks share: a legged robot follows a planar velocity command.

A task's module holds the figures of its robot and puts the parts together. Weights, noise and pushes are from mjlab
1.6.0's velocity tasks, so that both can be compared on the same work. So are the training settings but for two (see
`velocity_training`). One thing is ours: the actor's joint positions are a term of their own (`joint_pos_biased`), as
groups share terms by name.
"""

import dataclasses
import functools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

from ksim_rl import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import EventTerm, ObservationTerm, RewardTerm
from ksim_rl.physics import SimCfg
from ksim_rl.physics.load import Source
from ksim_rl.scene import terrains
from ksim_rl.scene.robots import stance
from ksim_rl.scene.robots.analysis import RobotAnalysis, analyse
from ksim_rl.scene.robots.legged_robot import LeggedRobot, ModelRobot
from ksim_rl.scene.robots.strangers_model import robot_name
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.sensors import ContactSensor, Sensor
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks.velocity_training import fast_sac_training, training
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg
from ksim_rl.transforms.noise.cfg import UniformNoise

COMMAND = "twist"
FEET = "feet_ground_contact"
"""The contact sensor with one element per foot, in the order of the robot's `foot_sites`."""
STAGES = "command_ranges"
"""The curriculum that makes commands faster."""
SELF = "self_collision"
"""The contact sensor of a robot against itself, for tasks that have one."""
MOVING = {"command": COMMAND, "command_threshold": 0.05}
"""Rewards of the feet count only while the command asks to move."""


@dataclass(frozen=True, kw_only=True)
class PoseStd:
    """How far joints may stray from the default pose, rad by joint pattern; see `mdp.Pose`."""

    standing: Mapping[str, float]
    walking: Mapping[str, float]
    running: Mapping[str, float]


def sim(*, cone: Literal["pyramidal", "elliptic"] = "pyramidal", impratio: float = 1.0) -> SimCfg:
    """Return the physics settings: 200 Hz, few solver iterations."""
    return dataclasses.replace(stance.SIM, cone=cone, impratio=impratio, ccd_iterations=50)


def noisy(term: ObservationTerm, reach: float) -> ObservationTermCfg:
    """Return an observation with uniform noise in [-reach, reach]."""
    return ObservationTermCfg(term=term, noise=UniformNoise(low=-reach, high=reach))


def observations(robot: LeggedRobot) -> dict[str, ObservationGroupCfg]:
    """Return the groups: a noisy "actor" and a clean "critic" that also sees the feet."""
    lin_vel = mdp.SensorReading(sensor="imu_lin_vel")
    ang_vel = mdp.SensorReading(sensor="imu_ang_vel")
    gravity = mdp.ProjectedGravity()
    joint_vel = mdp.JointVel(joints=robot.joint_names)
    seen_by_both = {
        "actions": ObservationTermCfg(term=mdp.LastAction()),
        "command": ObservationTermCfg(term=mdp.Command(command=COMMAND)),
    }
    actor = {
        "base_lin_vel": noisy(lin_vel, 0.5),
        "base_ang_vel": noisy(ang_vel, 0.2),
        "projected_gravity": noisy(gravity, 0.05),
        "joint_pos_biased": noisy(mdp.JointPosRel(joints=robot.joint_names, biased=True), 0.01),
        "joint_vel": noisy(joint_vel, 1.5),
        **seen_by_both,
    }
    critic = {
        "base_lin_vel": ObservationTermCfg(term=lin_vel),
        "base_ang_vel": ObservationTermCfg(term=ang_vel),
        "projected_gravity": ObservationTermCfg(term=gravity),
        "joint_pos": ObservationTermCfg(term=mdp.JointPosRel(joints=robot.joint_names)),
        "joint_vel": ObservationTermCfg(term=joint_vel),
        **seen_by_both,
        "foot_height": ObservationTermCfg(term=mdp.FootHeight(sites=robot.foot_sites)),
        "foot_air_time": ObservationTermCfg(term=mdp.FootAirTime(sensor=FEET)),
        "foot_contact": ObservationTermCfg(term=mdp.FootContact(sensor=FEET)),
        "foot_contact_forces": ObservationTermCfg(term=mdp.FootContactForces(sensor=FEET)),
    }
    return {"actor": ObservationGroupCfg(terms=actor), "critic": ObservationGroupCfg(terms=critic)}


def rewards(
    robot: LeggedRobot,
    *,
    pose: PoseStd,
    torso: str | None = None,
    body_ang_vel: float = 0.0,
    angular_momentum: float = 0.0,
    foot_height: float = 0.1,
) -> dict[str, RewardTerm]:
    """Return the rewards; `torso` is to stay upright and calm (None: the root), feet swing at `foot_height`, m."""
    sites = robot.foot_sites
    return {
        "track_linear_velocity": mdp.TrackLinearVelocity(weight=2.0, command=COMMAND, std=0.5),
        "track_angular_velocity": mdp.TrackAngularVelocity(
            weight=2.0, command=COMMAND, std=math.sqrt(0.5)
        ),
        "upright": mdp.Upright(weight=1.0, std=math.sqrt(0.2), body=torso),
        "pose": mdp.Pose(
            weight=1.0,
            command=COMMAND,
            std_standing=pose.standing,
            std_walking=pose.walking,
            std_running=pose.running,
            walking_threshold=0.05,
            running_threshold=1.5,
        ),
        "body_ang_vel": mdp.BodyAngularVelocity(weight=body_ang_vel, body=torso or robot.root_body),
        "angular_momentum": mdp.AngularMomentum(weight=angular_momentum, sensor="root_angmom"),
        "dof_pos_limits": mdp.JointPosLimits(weight=-1.0),
        "action_rate_l2": mdp.ActionRateL2(weight=-0.1),
        "air_time": mdp.FeetAirTime(
            weight=0.0,
            sensor=FEET,
            threshold_min=0.05,
            threshold_max=0.5,
            command=COMMAND,
            command_threshold=0.5,
        ),
        "foot_clearance": mdp.FootClearance(
            weight=-2.0, sites=sites, target_height=foot_height, **MOVING
        ),
        "foot_swing_height": mdp.FootSwingHeight(
            weight=-0.25, sensor=FEET, sites=sites, target_height=foot_height, **MOVING
        ),
        "foot_slip": mdp.FootSlip(weight=-0.1, sensor=FEET, sites=sites, **MOVING),
        "soft_landing": mdp.SoftLanding(weight=-1e-5, sensor=FEET, **MOVING),
    }


def feet_sensor(
    *, geoms: Sequence[str] = (), bodies: Sequence[str] = (), subtrees: Sequence[str] = ()
) -> ContactSensor:
    """Return the sensor of the feet's contacts, one element per foot.

    Its clocks run in physics steps, as mjlab's: a foot that lands and bounces off within an env step is seen, which 22
    to 46 % of landings do.
    """
    return ContactSensor(
        geoms=tuple(geoms), bodies=tuple(bodies), subtrees=tuple(subtrees), every_substep=True
    )


def self_contact(robot: LeggedRobot) -> dict[str, Sensor]:
    """Return the sensor of the robot's strongest contact with itself, in every substep."""
    root = robot.root_body
    sensor = ContactSensor(
        subtrees=(root,),
        against=root,
        against_kind="subtree",
        reduce="strongest",
        every_substep=True,
    )
    return {SELF: sensor}


def events(robot: LeggedRobot, *, torso: str | None = None) -> dict[str, EventTerm]:
    """Return resets, pushes and start-up randomization, of the torso's centre of mass (None: the root's) too.

    The friction of feet is the task's own (`foot_friction`).
    """
    return {
        "reset_base": mdp.ResetRootUniform(
            pose_range={"x": (-0.5, 0.5), "y": (-0.5, 0.5), "z": (0.01, 0.05), "yaw": (-3.14, 3.14)}
        ),
        "reset_robot_joints": mdp.ResetJoints(),
        "push_robot": mdp.PushByVelocity(
            interval_range_s=(1.0, 3.0),
            velocity_range={
                **dict.fromkeys(("x", "y"), (-0.5, 0.5)),
                "z": (-0.4, 0.4),
                **dict.fromkeys(("roll", "pitch"), (-0.52, 0.52)),
                "yaw": (-0.78, 0.78),
            },
        ),
        "encoder_bias": mdp.RandomizeEncoderBias(ranges=(-0.015, 0.015)),
        "base_com": mdp.RandomizeBodyCom(
            bodies=(torso or robot.root_body,),
            operation="add",
            ranges={0: (-0.025, 0.025), 1: (-0.025, 0.025), 2: (-0.03, 0.03)},
        ),
    }


def foot_friction(
    robot: LeggedRobot, *, axis: int = 0, low: float, high: float, log: bool = False
) -> mdp.RandomizeGeomFriction:
    """Return the start-up draw of one friction coefficient, the same for all feet of a world."""
    return mdp.RandomizeGeomFriction(
        geoms=robot.foot_geoms,
        ranges={axis: (low, high)},
        distribution="log_uniform" if log else "uniform",
        shared=True,
    )


def velocity_command() -> mdp.UniformVelocityCommand:
    """Return the command: up to 1 m/s in any direction, 0.5 rad/s about the vertical."""
    return mdp.UniformVelocityCommand(
        resampling_time_range_s=(3.0, 8.0),
        lin_vel_x=(-1.0, 1.0),
        lin_vel_y=(-1.0, 1.0),
        ang_vel_z=(-0.5, 0.5),
        heading=(-math.pi, math.pi),
        heading_stiffness=0.5,
        rel_standing_envs=0.1,
        rel_heading_envs=0.3,
        rel_forward_envs=0.2,
    )


def command_stages() -> mdp.CommandRangesByStage:
    """Return the curriculum of `velocity_command()`: faster from 120,000 env steps on, and up to 3 m/s from 240,000."""
    rollout = 24
    stages = {
        5_000 * rollout: {"lin_vel_x": (-1.5, 2.0), "ang_vel_z": (-0.7, 0.7)},
        10_000 * rollout: {"lin_vel_x": (-2.0, 3.0)},
    }
    return mdp.CommandRangesByStage(command=COMMAND, stages=stages)


def on_plane(robot: LeggedRobot, sensors: Mapping[str, Sensor] | None = None) -> SceneCfg:
    """Return the scene of a robot on a plane, 4096 times."""
    return SceneCfg(
        robots={robot.name: robot},
        terrain=terrains.PlaneTerrain(),
        sensors=sensors or {},
        num_envs=4096,
        soft_joint_pos_limit_factor=robot.soft_joint_pos_limit_factor,
    )


def velocity_cfg(
    robot: LeggedRobot,
    *,
    sim: SimCfg,
    feet: ContactSensor,
    rewards: Mapping[str, RewardTerm],
    events: Mapping[str, EventTerm],
    viewer: ViewerCfg,
    observations: Mapping[str, ObservationGroupCfg],
    sensors: Mapping[str, Sensor] | None = None,
) -> ManagerBasedRlEnvCfg:
    """Return the config: 50 Hz control; an episode lasts 20 s, or until the root tilts by more than 70 degrees.

    `feet` has one element per foot in the order of `robot.foot_sites`. The command is `velocity_command()`;
    `with_command` gives another one. The ground is a plane; `rough_ground.on_rough_ground` changes that.
    """
    elements = feet.geoms or feet.bodies or feet.subtrees
    num_feet = len(robot.foot_sites)
    if len(elements) != num_feet and all(re.fullmatch(r"[\w/-]+", element) for element in elements):
        raise ValueError(
            f"feet: {len(elements)} {feet.kind} elements {elements} for {num_feet} foot_sites: give one per foot; for "
            "feet of several geoms ContactSensor(bodies=...) or ContactSensor(subtrees=...)"
        )
    return ManagerBasedRlEnvCfg(
        decimation=4,
        sim=sim,
        scene=on_plane(robot, {FEET: feet, **(sensors or {})}),
        observations=observations,
        actions={
            "joint_pos": mdp.JointPositionAction(joints=robot.joint_names, scale=robot.action_scale)
        },
        commands={COMMAND: velocity_command()},
        curriculum={STAGES: command_stages()},
        rewards=rewards,
        events=events,
        terminations={
            "time_out": mdp.TimeOut(),
            "fell_over": mdp.BadOrientation(limit_angle=math.radians(70.0)),
        },
        metrics={
            "linear_velocity_error": mdp.LinearVelocityError(command=COMMAND),
            "angular_velocity_error": mdp.AngularVelocityError(command=COMMAND),
            "action_acceleration": mdp.ActionAcceleration(),
        },
        episode_length_s=20.0,
        viewer=viewer,
    )


def with_command(
    cfg: ManagerBasedRlEnvCfg, command: mdp.UniformVelocityCommand
) -> ManagerBasedRlEnvCfg:
    """Return a velocity task's config with another command, without the stages, which fit `velocity_command()`."""
    curriculum = {name: term for name, term in cfg.curriculum.items() if name != STAGES}
    return dataclasses.replace(cfg, commands={COMMAND: command}, curriculum=curriculum)


def flat_cfg(
    robot: LeggedRobot,
    pose: PoseStd,
    *,
    is_biped: bool = False,
    torso: str | None = None,
    foot_height: float = 0.1,
    friction: Mapping[str, EventTerm] | None = None,
    physics: SimCfg | None = None,
    **others: Any,
) -> ManagerBasedRlEnvCfg:
    """Return `velocity_cfg`, to which `others` go, with the parts of this module.

    Bipeds are calmer, and keep their limbs apart.
    """
    calm: dict[str, float] = {"body_ang_vel": -0.05, "angular_momentum": -0.02} if is_biped else {}
    earned = rewards(robot, pose=pose, torso=torso, foot_height=foot_height, **calm)
    if is_biped:
        earned["self_collisions"] = mdp.SelfCollision(weight=-1.0, sensor=SELF)
    slip = (
        {"foot_friction": foot_friction(robot, low=0.3, high=1.2)} if friction is None else friction
    )
    return velocity_cfg(
        robot,
        sim=physics or sim(),
        rewards=earned,
        events={**events(robot, torso=torso), **slip},
        observations=observations(robot),
        sensors=self_contact(robot) if is_biped else {},
        **others,
    )


class VelocityTask(Task):
    """A velocity task on flat ground, for any robot."""

    @classmethod
    def for_robot(
        cls,
        robot: Source | ModelRobot | RobotAnalysis,
        *,
        name: str = "",
        num_iterations: int = 3_000,
        pose: str | None = None,
    ) -> "VelocityTask":
        """Return the task of a robot: a model, its analysis by `robots.analyse`, or an edited proposal of one.

        A model is analysed when the config is first asked for, from the keyframe `pose` where one is named. `name` is
        "<robot>_velocity_flat" by default.
        """
        if isinstance(robot, RobotAnalysis):
            own = robot.robot.name
        elif isinstance(robot, ModelRobot):
            own = robot.name
        else:
            own = robot_name(robot)

        @functools.cache
        def analysis() -> RobotAnalysis:
            if isinstance(robot, RobotAnalysis):
                return robot
            if isinstance(robot, ModelRobot):
                return analyse(robot.spec(), pose=pose)
            return analyse(robot, pose=pose)

        def cfg() -> ManagerBasedRlEnvCfg:
            # An edited proposal is taken as it is.
            proposed = robot if isinstance(robot, ModelRobot) else analysis().robot
            return _proposed_cfg(proposed, analysis())

        return cls(
            name=name or f"{own}_velocity_flat",
            description=f"{own} follows a velocity command on flat ground",
            cfg=cfg,
            training=training(num_iterations=num_iterations),
            # Left and right are seldom quite equal.
            other_trainings=(fast_sac_training(symmetry="none"),),
        )


def _proposed_cfg(proposed: ModelRobot, analysis: RobotAnalysis) -> ManagerBasedRlEnvCfg:
    """Return the config of a robot of any size; bipeds are slower."""
    robot = cast(LeggedRobot, proposed)
    height = proposed.init_pos[2]
    biped = len(analysis.foot_bodies) == 2
    if biped:
        moving = analysis.by_joint(0.35, 0.15, 0.15)
        # A leg's natural speed grows with the root of its length: 1 m/s is much for a leg of 0.25 m.
        speed = round(min(1.0, 0.5 * math.sqrt(9.81 * height)), 2)
    else:
        moving = analysis.by_joint(0.6, 0.3, 0.15)
        speed = 1.0
    pose = PoseStd(standing={".*": 0.05}, walking=moving, running=analysis.by_joint(0.6, 0.3, 0.4))
    slow = dataclasses.replace(
        velocity_command(), lin_vel_x=(-speed, speed), lin_vel_y=(-speed, speed)
    )
    cfg = flat_cfg(
        robot,
        pose,
        feet=feet_sensor(bodies=analysis.foot_bodies),
        is_biped=biped,
        foot_height=round(min(0.1, 0.3 * height), 3),
        viewer=ViewerCfg(body=robot.root_body, distance=max(1.0, 4.0 * height), elevation=-12.0),
    )
    return with_command(cfg, slow)
