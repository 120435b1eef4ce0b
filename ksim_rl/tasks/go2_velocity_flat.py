"""Unitree Go2 follows a velocity command on flat ground; its motors run PD control."""

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.robots.unitree_go2 import UnitreeGo2
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity

ROBOT = UnitreeGo2()
HIP_AND_THIGH, CALF = ".*_(hip|thigh)_joint", ".*_calf_joint"
POSE = velocity.PoseStd(
    standing={HIP_AND_THIGH: 0.05, CALF: 0.1},
    walking={HIP_AND_THIGH: 0.3, CALF: 0.6},
    running={HIP_AND_THIGH: 0.3, CALF: 0.6},
)


def go2_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return velocity.velocity_cfg(
        ROBOT,
        sim=velocity.sim(),
        feet=ContactSensor(geoms=ROBOT.foot_geoms),
        observations=velocity.observations(ROBOT),
        rewards=velocity.rewards(ROBOT, pose=POSE),
        events=velocity.events(ROBOT) | {"foot_friction": velocity.foot_friction(ROBOT, low=0.3, high=1.5)},
        viewer=ViewerCfg(body=ROBOT.root_body, distance=1.5, elevation=-10.0, azimuth=90.0),
    )


TASK = Task(
    name="go2_velocity_flat",
    description="Unitree Go2 follows a velocity command on flat ground",
    cfg=go2_velocity_flat,
    training=velocity.training(num_iterations=10_000),
)
