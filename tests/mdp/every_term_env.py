"""A walking quadruped that is observed and rewarded by every term that suits it."""

import torch

from benchmarks.agreement_models import LEGS, QUADRUPED
from ksim_rl import mdp
from ksim_rl.envs import (
    ManagerBasedRlEnv,
    ManagerBasedRlEnvCfg,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    SceneCfg,
)
from ksim_rl.envs.term import ObservationTerm, RewardTerm
from ksim_rl.physics import SimCfg
from ksim_rl.scene.sensors import ContactSensor

FEET, BODIES = ".*_foot", ("torso", "front_left_.*")
MOVING = {"command": "twist", "command_threshold": 0.05}

OBSERVATIONS: dict[str, ObservationTerm] = {
    term.__class__.__name__ + suffix: term
    for suffix, terms in {
        "": (
            mdp.RootPos(),
            mdp.RootQuat(),
            mdp.RootRotation6d(),
            mdp.RootLinVel(),
            mdp.RootAngVel(),
            mdp.ProjectedGravity(),
            mdp.SensorReading(sensor="acceleration"),
            mdp.LastAction(),
            mdp.Command(command="twist"),
            mdp.JointPos(),
            mdp.JointPosRel(biased=True),
            mdp.JointPosTarget(),
            mdp.JointVel(),
            mdp.JointAcc(),
            mdp.JointEffort(),
            mdp.ActuatorForce(),
            mdp.BodyPos(bodies=BODIES),
            mdp.BodyQuat(bodies=BODIES),
            mdp.BodyRotation6d(bodies=BODIES),
            mdp.SiteRotation6d(sites=FEET),
            mdp.CenterOfMassInertia(bodies=BODIES),
            mdp.BodyLinVel(bodies=BODIES),
            mdp.BodyAngVel(bodies=BODIES),
            mdp.CenterOfMassPos(bodies="torso"),
            mdp.CenterOfMassVel(bodies="torso"),
            mdp.Contact(sensor="feet", threshold=1.0),
            mdp.ContactForce(sensor="feet"),
            mdp.FootAirTime(sensor="feet"),
            mdp.FootContact(sensor="feet"),
            mdp.FootContactForces(sensor="feet"),
            mdp.FootHeight(sites=FEET),
            mdp.FootPos(sites=FEET),
            mdp.OffsetToBody(site="front_left_foot", body="torso"),
            mdp.OffsetToCommand(command="target", body="front_left_thigh"),
            mdp.EpisodeTime(),
            mdp.RemainingTime(),
            mdp.Clock(frequency=1.5, phases=(0.0, 0.5)),
        ),
        "_lagging": (mdp.ProjectedGravity(time_constant=0.05),),
        "_in_world": (
            mdp.RootLinVel(frame="world"),
            mdp.RootAngVel(frame="world"),
            mdp.BodyPos(bodies=BODIES, frame="world"),
            mdp.FootPos(sites=FEET, frame="world"),
        ),
        "_in_root": (mdp.ContactForce(sensor="feet", frame="root"),),
    }.items()
    for term in terms
}
REWARDS: dict[str, RewardTerm] = {
    term.__class__.__name__: term
    for term in (
        mdp.Alive(),
        mdp.Terminated(weight=-1.0),
        mdp.ActionRateL2(weight=-0.1),
        mdp.ActionAccelerationL2(weight=-0.1),
        mdp.ActionJerkL2(weight=-0.1),
        mdp.TrackLinearVelocity(command="twist", std=0.5),
        mdp.TrackAngularVelocity(command="twist", std=0.5),
        mdp.TrackRootHeight(command="height", std=0.2),
        mdp.NearBody(site="front_left_foot", body="torso", std=0.3),
        mdp.TrackPosition(command="target", std=0.3, body="front_left_thigh"),
        mdp.TrackOrientation(command="target", std=1.0, body="torso", frame="world"),
        mdp.TrackJointPosition(command="joints", std=0.5),
        mdp.Upright(std=0.5),
        mdp.TiltL2(weight=-1.0, body="torso"),
        mdp.RootHeightL2(weight=-1.0, target_height=0.4),
        mdp.RootHeightInside(height=(0.3, 0.5), margin=0.2),
        mdp.Pose(
            command="twist",
            std_standing={".*": 0.1},
            std_walking={".*": 0.2},
            std_running={".*": 0.3},
            walking_threshold=0.1,
            running_threshold=0.5,
        ),
        mdp.LinVelZL2(weight=-1.0),
        mdp.AngVelXYL2(weight=-0.1),
        mdp.BodyAngularVelocity(weight=-0.1, body="torso"),
        mdp.AngularMomentum(weight=-0.1, sensor="momentum"),
        mdp.LinkAccelerationL2(weight=-1e-4, bodies=BODIES),
        mdp.LinkJerkL2(weight=-1e-7, bodies=BODIES),
        mdp.MotionlessAtRest(weight=-0.1, command="twist", command_threshold=0.2),
        mdp.JointPosLimits(weight=-1.0),
        mdp.JointDeviationL1(weight=-0.1),
        mdp.JointDeviationL2(weight=-0.1),
        mdp.JointVelL2(weight=-1e-3),
        mdp.JointVelLimits(weight=-0.1, limits={".*": 1.0}),
        mdp.JointAccL2(weight=-1e-6),
        mdp.JointJerkL2(weight=-1e-9),
        mdp.UnreachableTargetL2(
            weight=-1.0, max_velocity={".*": 1.0}, max_acceleration={".*": 10.0}
        ),
        mdp.JointEffortL2(weight=-1e-4),
        mdp.JointEffortLimits(weight=-1e-2, limits={".*": 5.0}, soft_factor=0.5),
        mdp.ActuatorForceL2(weight=-1e-4),
        mdp.Energy(weight=-1e-3),
        mdp.JointSymmetryL2(weight=-0.1, left=".*_left_.*", right=".*_right_.*"),
        mdp.ActionSymmetryL2(weight=-0.1, left=".*_left_hip", right=".*_right_hip", joints=".*"),
        mdp.ContactForceAbove(weight=-1e-3, sensor="feet", threshold=20.0),
        mdp.UndesiredContacts(weight=-0.1, sensor="feet"),
        mdp.SelfCollision(weight=-0.1, sensor="self"),
        mdp.FeetAirTime(sensor="feet", threshold_min=0.01, threshold_max=0.1, **MOVING),
        mdp.FootClearance(weight=-1.0, sites=FEET, target_height=0.05, **MOVING),
        mdp.FootSwingHeight(weight=-1.0, sensor="feet", sites=FEET, target_height=0.05, **MOVING),
        mdp.FootSwingPeak(sensor="feet", sites=FEET, target_height=0.05, **MOVING),
        mdp.FeetTooClose(weight=-1.0, sites=FEET, min_distance=1.0),
        mdp.FootSlip(weight=-1.0, sensor="feet", sites=FEET, **MOVING),
        mdp.SoftLanding(weight=-1e-2, sensor="feet", **MOVING),
        mdp.GaitPhase(gait="gait", sensor="feet", **MOVING),
    )
}


def every_term_env(num_envs: int = 3, device: str = "cpu") -> ManagerBasedRlEnv:
    """Build the env: 50 Hz, episodes of 0.24 s, pushes, commands that change often."""
    group = ObservationGroupCfg(
        terms={name: ObservationTermCfg(term=term) for name, term in OBSERVATIONS.items()}
    )
    often = {"resampling_time_range_s": (0.04, 0.1)}
    cfg = ManagerBasedRlEnvCfg(
        decimation=4,
        sim=SimCfg(njmax=80, nconmax=40),
        scene=SceneCfg(
            robots={"quadruped": MjcfRobot(source=QUADRUPED)},
            sensors={
                "feet": ContactSensor(
                    geoms=tuple(f"{leg}_foot" for leg in LEGS), against="floor", against_kind="geom"
                ),
                "self": ContactSensor(
                    subtrees=("torso",), against="torso", against_kind="subtree", reduce="strongest"
                ),
            },
            num_envs=num_envs,
        ),
        observations={"actor": group, "critic": group},
        actions={"joints": mdp.JointPositionAction(joints=".*", scale=0.3)},
        commands={
            "twist": mdp.UniformVelocityCommand(
                lin_vel_x=(-1, 1),
                lin_vel_y=(-1, 1),
                ang_vel_z=(-1, 1),
                rel_standing_envs=0.3,
                **often,
            ),
            "height": mdp.BaseHeightCommand(height=(0.3, 0.5), **often),
            "joints": mdp.JointPositionCommand(joints=".*", offset=(-0.2, 0.2), **often),
            "target": mdp.CartesianCommand(
                position={"x": (0.1, 0.3)}, orientation={"yaw": (-1, 1)}, **often
            ),
            "gait": mdp.SinusoidalGaitCommand(frequency=(1.0, 2.0), offsets=(0.0, 0.5, 0.5, 0.0)),
        },
        rewards=REWARDS,
        events={
            "root": mdp.ResetRootUniform(pose_range={"roll": (-0.3, 0.3), "yaw": (-3, 3)}),
            "joints": mdp.ResetJoints(position_range=(-0.2, 0.2), velocity_range=(-1, 1)),
            "push": mdp.PushByVelocity(
                velocity_range={"x": (-1, 1)}, mode="interval", interval_range_s=(0.04, 0.1)
            ),
        },
        terminations={
            "time_out": mdp.TimeOut(),
            "fell": mdp.BadOrientation(limit_angle=0.25),
        },
        episode_length_s=0.24,
        seed=0,
    )
    return ManagerBasedRlEnv(cfg, device)


def actions(steps: int, env: ManagerBasedRlEnv) -> torch.Tensor:
    """Draw actions, [steps, E, 8], on the CPU."""
    return torch.randn(steps, env.num_envs, 8, generator=torch.Generator().manual_seed(1))
