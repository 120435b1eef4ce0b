"""Unitree Go1 follows a velocity command on flat ground.

The figures are those of mjlab 1.6.0's `Mjlab-Velocity-Flat-Unitree-Go1`.
"""

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.robots.unitree_go1 import UnitreeGo1
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity

ROBOT = UnitreeGo1()
HIP_AND_THIGH, CALF = ".*_(hip|thigh)_joint", ".*_calf_joint"
POSE = velocity.PoseStd(
    standing={HIP_AND_THIGH: 0.05, CALF: 0.1},
    walking={HIP_AND_THIGH: 0.3, CALF: 0.6},
    running={HIP_AND_THIGH: 0.3, CALF: 0.6},
)
FEET = ContactSensor(geoms=ROBOT.foot_geoms)
SIM = velocity.sim(cone="elliptic", impratio=10.0)
VIEWER = ViewerCfg(body=ROBOT.root_body, distance=1.5, elevation=-10.0, azimuth=90.0)
# Sliding, spinning and rolling: the feet's contacts have all six dimensions.
FOOT_FRICTION = {
    "foot_friction_slide": velocity.foot_friction(ROBOT, axis=0, low=0.3, high=1.5),
    "foot_friction_spin": velocity.foot_friction(ROBOT, axis=1, low=1e-4, high=2e-2, log=True),
    "foot_friction_roll": velocity.foot_friction(ROBOT, axis=2, low=1e-5, high=5e-3, log=True),
}


def go1_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return velocity.velocity_cfg(
        ROBOT,
        sim=SIM,
        feet=FEET,
        observations=velocity.observations(ROBOT),
        rewards=velocity.rewards(ROBOT, pose=POSE),
        events=velocity.events(ROBOT) | FOOT_FRICTION,
        viewer=VIEWER,
    )


TASK = Task(
    name="go1_velocity_flat",
    description="Unitree Go1 follows a velocity command on flat ground",
    cfg=go1_velocity_flat,
    training=velocity.training(num_iterations=10_000),
    other_trainings=velocity.off_policy_trainings(),
)
