"""Unitree Go1 follows a velocity command on flat ground.

The figures are those of mjlab 1.6.0's `Mjlab-Velocity-Flat-Unitree-Go1`, so that both can be compared on the same
work. Two things are ours: the actor's joint positions are a term of their own (`joint_pos_biased`), because groups
share terms by name; and the encoders' bias reaches that observation only, not the servo targets.
"""

import math

from ksim_rl.envs import mdp
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.robots.unitree_go1 import UnitreeGo1
from ksim_rl.envs.scene import PlaneTerrain, SceneCfg
from ksim_rl.envs.sensors import ContactSensor
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import EventTerm, RewardTerm
from ksim_rl.envs.transforms.group_cfg import ObservationGroupCfg, ObservationTermCfg
from ksim_rl.envs.transforms.noise_cfg import UniformNoise
from ksim_rl.envs.viewer_cfg import ViewerCfg
from ksim_rl.physics import SimCfg

ROBOT = UnitreeGo1()
COMMAND = "twist"
FEET = "feet_ground_contact"


def _observations() -> dict[str, ObservationGroupCfg]:
    def noisy(term: ObservationTermCfg, reach: float) -> ObservationTermCfg:
        return ObservationTermCfg(term=term.term, noise=UniformNoise(low=-reach, high=reach))

    lin_vel = ObservationTermCfg(term=mdp.SensorReading(sensor="imu_lin_vel"))
    ang_vel = ObservationTermCfg(term=mdp.SensorReading(sensor="imu_ang_vel"))
    gravity = ObservationTermCfg(term=mdp.ProjectedGravity())
    joint_pos = ObservationTermCfg(term=mdp.JointPosRel(joints=ROBOT.joint_names))
    biased_pos = ObservationTermCfg(term=mdp.JointPosRel(joints=ROBOT.joint_names, biased=True))
    joint_vel = ObservationTermCfg(term=mdp.JointVel(joints=ROBOT.joint_names))
    actions = ObservationTermCfg(term=mdp.LastAction())
    command = ObservationTermCfg(term=mdp.Command(command=COMMAND))
    actor = {
        "base_lin_vel": noisy(lin_vel, 0.5),
        "base_ang_vel": noisy(ang_vel, 0.2),
        "projected_gravity": noisy(gravity, 0.05),
        "joint_pos_biased": noisy(biased_pos, 0.01),
        "joint_vel": noisy(joint_vel, 1.5),
        "actions": actions,
        "command": command,
    }
    critic = {
        "base_lin_vel": lin_vel,
        "base_ang_vel": ang_vel,
        "projected_gravity": gravity,
        "joint_pos": joint_pos,
        "joint_vel": joint_vel,
        "actions": actions,
        "command": command,
        "foot_height": ObservationTermCfg(term=mdp.FootHeight(sites=ROBOT.foot_sites)),
        "foot_air_time": ObservationTermCfg(term=mdp.FootAirTime(sensor=FEET)),
        "foot_contact": ObservationTermCfg(term=mdp.FootContact(sensor=FEET)),
        "foot_contact_forces": ObservationTermCfg(term=mdp.FootContactForces(sensor=FEET)),
    }
    return {"actor": ObservationGroupCfg(terms=actor), "critic": ObservationGroupCfg(terms=critic)}


def _rewards() -> dict[str, RewardTerm]:
    hip_and_thigh, calf = ".*_(hip|thigh)_joint", ".*_calf_joint"
    sites, moving = ROBOT.foot_sites, {"command": COMMAND, "command_threshold": 0.05}
    return {
        "track_linear_velocity": mdp.TrackLinearVelocity(weight=2.0, command=COMMAND, std=0.5),
        "track_angular_velocity": mdp.TrackAngularVelocity(weight=2.0, command=COMMAND, std=math.sqrt(0.5)),
        "upright": mdp.Upright(weight=1.0, std=math.sqrt(0.2)),
        "pose": mdp.Pose(
            weight=1.0,
            command=COMMAND,
            std_standing={hip_and_thigh: 0.05, calf: 0.1},
            std_walking={hip_and_thigh: 0.3, calf: 0.6},
            std_running={hip_and_thigh: 0.3, calf: 0.6},
            walking_threshold=0.05,
            running_threshold=1.5,
        ),
        "body_ang_vel": mdp.BodyAngularVelocity(weight=0.0, body=ROBOT.root_body),
        "angular_momentum": mdp.AngularMomentum(weight=0.0, sensor="root_angmom"),
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
        "foot_clearance": mdp.FootClearance(weight=-2.0, sites=sites, target_height=0.1, **moving),
        "foot_swing_height": mdp.FootSwingHeight(
            weight=-0.25, sensor=FEET, sites=sites, target_height=0.1, **moving
        ),
        "foot_slip": mdp.FootSlip(weight=-0.1, sensor=FEET, sites=sites, **moving),
        "soft_landing": mdp.SoftLanding(weight=-1e-5, sensor=FEET, **moving),
    }


def _events() -> dict[str, EventTerm]:
    def foot_friction(axis: int, low: float, high: float, *, log: bool = False) -> mdp.RandomizeGeomFriction:
        return mdp.RandomizeGeomFriction(
            elements=ROBOT.foot_geoms,
            ranges={axis: (low, high)},
            distribution="log_uniform" if log else "uniform",
            shared=True,
        )

    return {
        "reset_base": mdp.ResetRootUniform(
            pose_range={"x": (-0.5, 0.5), "y": (-0.5, 0.5), "z": (0.01, 0.05), "yaw": (-3.14, 3.14)}
        ),
        "reset_robot_joints": mdp.ResetJoints(),
        "push_robot": mdp.PushByVelocity(
            interval_range_s=(1.0, 3.0),
            velocity_range={
                "x": (-0.5, 0.5),
                "y": (-0.5, 0.5),
                "z": (-0.4, 0.4),
                "roll": (-0.52, 0.52),
                "pitch": (-0.52, 0.52),
                "yaw": (-0.78, 0.78),
            },
        ),
        "encoder_bias": mdp.RandomizeEncoderBias(bias_range=(-0.015, 0.015)),
        "base_com": mdp.RandomizeBodyCom(
            elements=(ROBOT.root_body,),
            operation="add",
            ranges={0: (-0.025, 0.025), 1: (-0.025, 0.025), 2: (-0.03, 0.03)},
        ),
        "foot_friction_slide": foot_friction(0, 0.3, 1.5),
        "foot_friction_spin": foot_friction(1, 1e-4, 2e-2, log=True),
        "foot_friction_roll": foot_friction(2, 1e-5, 5e-3, log=True),
    }


def go1_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config: 50 Hz control; an episode lasts 20 s, or until the trunk tilts by more than 70 degrees."""
    return ManagerBasedRlEnvCfg(
        decimation=4,
        sim=SimCfg(
            timestep=0.005,
            integrator="implicitfast",
            solver="newton",
            cone="elliptic",
            impratio=10.0,
            iterations=10,
            ls_iterations=20,
            ccd_iterations=50,
        ),
        scene=SceneCfg(
            robots={"go1": ROBOT},
            terrain=PlaneTerrain(),
            sensors={FEET: ContactSensor(geoms=ROBOT.foot_geoms)},
            num_envs=4096,
            soft_joint_pos_limit_factor=ROBOT.soft_joint_pos_limit_factor,
        ),
        observations=_observations(),
        actions={"joint_pos": mdp.JointPositionAction(joints=ROBOT.joint_names, scale=ROBOT.action_scale)},
        commands={
            COMMAND: mdp.UniformVelocityCommand(
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
        },
        rewards=_rewards(),
        events=_events(),
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
        viewer=ViewerCfg(body=ROBOT.root_body, distance=1.5, elevation=-10.0, azimuth=90.0),
    )


TASK = Task(
    name="go1_velocity_flat",
    description="Unitree Go1 follows a velocity command on flat ground",
    cfg=go1_velocity_flat,
    training={
        "num_envs": 4096,
        "seed": 42,
        # 24 steps of 4096 envs
        "data.num_env_states_per_minibatch": 24 * 4096 // 4,
        "data.num_minibatches": 4,
        "objective.num_epochs": 5,
        "objective.learning_rate": 1e-3,
        "objective.schedule": "adaptive",
        "objective.desired_kl": 0.01,
        "objective.gamma": 0.99,
        "objective.lmbda": 0.95,
        "objective.entropy_coeff": 0.01,
        "objective.critic_coeff": 1.0,
        "objective.clip_epsilon": 0.2,
        "objective.clip_value": True,
        "objective.normalize_advantage": "dataset",
        "objective.max_grad_norm": 1.0,
        "modules.actor.hidden_dims": [512, 256, 128],
        "modules.actor.activation": "elu",
        "modules.actor.obs_normalization": True,
        "modules.actor.init_std": 1.0,
        "modules.actor.std_type": "scalar",
        "modules.critic.hidden_dims": [512, 256, 128],
        "modules.critic.activation": "elu",
        "modules.critic.obs_normalization": True,
        "trainer.num_iterations": 10000,
    },
)
