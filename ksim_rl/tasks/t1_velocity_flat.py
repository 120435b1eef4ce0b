"""Booster T1 follows a velocity command on flat ground."""

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.robots.booster_t1 import BoosterT1
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity

ROBOT = BoosterT1()
POSE = velocity.PoseStd(
    standing={".*": 0.05},
    walking={
        ".*_Hip_Pitch": 0.3,
        ".*_Hip_(Roll|Yaw)": 0.15,
        ".*_Knee_Pitch": 0.35,
        ".*_Ankle_Pitch": 0.25,
        ".*_Ankle_Roll": 0.1,
        "Waist": 0.2,
        ".*_Shoulder_.*": 0.15,
        ".*_Elbow_.*": 0.15,
        "AAHead_yaw|Head_pitch": 0.1,
    },
    running={
        ".*_Hip_Pitch": 0.5,
        ".*_Hip_(Roll|Yaw)": 0.2,
        ".*_Knee_Pitch": 0.6,
        ".*_Ankle_Pitch": 0.35,
        ".*_Ankle_Roll": 0.15,
        "Waist": 0.3,
        ".*_Shoulder_.*": 0.4,
        ".*_Elbow_.*": 0.35,
        "AAHead_yaw|Head_pitch": 0.1,
    },
)


def t1_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return velocity.velocity_cfg(
        ROBOT,
        sim=velocity.sim(),
        feet=ContactSensor(subtrees=ROBOT.foot_bodies),
        sensors=velocity.self_contact(ROBOT),
        observations=velocity.observations(ROBOT),
        rewards=velocity.rewards(ROBOT, pose=POSE, body_ang_vel=-0.05, angular_momentum=-0.02)
        | velocity.self_collisions(),
        events=velocity.events(ROBOT) | {"foot_friction": velocity.foot_friction(ROBOT, low=0.3, high=1.2)},
        viewer=ViewerCfg(body=ROBOT.root_body, distance=3.0, elevation=-10.0, azimuth=90.0),
    )


TASK = Task(
    name="t1_velocity_flat",
    description="Booster T1 follows a velocity command on flat ground",
    cfg=t1_velocity_flat,
    training=velocity.training(num_iterations=30_000),
)
