"""Unitree G1 follows a velocity command on flat ground.

The figures are those of mjlab 1.6.0's `Mjlab-Velocity-Flat-Unitree-G1`.
"""

import dataclasses

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity

ROBOT = UnitreeG1()
POSE = velocity.PoseStd(
    standing={".*": 0.05},
    walking={
        ".*_hip_pitch_joint": 0.3,
        ".*_hip_(roll|yaw)_joint": 0.15,
        ".*_knee_joint": 0.35,
        ".*_ankle_pitch_joint": 0.25,
        ".*_ankle_roll_joint": 0.1,
        "waist_yaw_joint": 0.2,
        "waist_roll_joint": 0.08,
        "waist_pitch_joint": 0.1,
        ".*_shoulder_(pitch|roll)_joint": 0.15,
        ".*_shoulder_yaw_joint": 0.1,
        ".*_elbow_joint": 0.15,
        ".*_wrist_.*": 0.3,
    },
    running={
        ".*_hip_pitch_joint": 0.5,
        ".*_hip_(roll|yaw)_joint": 0.2,
        ".*_knee_joint": 0.6,
        ".*_ankle_pitch_joint": 0.35,
        ".*_ankle_roll_joint": 0.15,
        "waist_yaw_joint": 0.3,
        "waist_roll_joint": 0.08,
        "waist_pitch_joint": 0.2,
        ".*_shoulder_pitch_joint": 0.5,
        ".*_shoulder_roll_joint": 0.2,
        ".*_shoulder_yaw_joint": 0.15,
        ".*_elbow_joint": 0.35,
        ".*_wrist_.*": 0.3,
    },
)
FEET = ContactSensor(subtrees=ROBOT.foot_bodies)
# A robot that lies on its arms needs 221 rows, more than the probe of the model finds.
SIM = dataclasses.replace(velocity.sim(), njmax=256)
VIEWER = ViewerCfg(body=ROBOT.torso_body, distance=3.0, elevation=-10.0, azimuth=90.0)


def g1_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return velocity.velocity_cfg(
        ROBOT,
        sim=SIM,
        feet=FEET,
        observations=velocity.observations(ROBOT),
        sensors=velocity.self_contact(ROBOT),
        rewards=velocity.rewards(
            ROBOT, pose=POSE, torso=ROBOT.torso_body, body_ang_vel=-0.05, angular_momentum=-0.02
        )
        | velocity.self_collisions(),
        events=velocity.events(ROBOT, torso=ROBOT.torso_body)
        | {"foot_friction": velocity.foot_friction(ROBOT, low=0.3, high=1.2)},
        viewer=VIEWER,
    )


TASK = Task(
    name="g1_velocity_flat",
    description="Unitree G1 follows a velocity command on flat ground",
    cfg=g1_velocity_flat,
    training=velocity.training(num_iterations=30_000),
)
