"""Our own quadruped follows a velocity command on flat ground; nothing to download."""

import dataclasses

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.robots.own_robots import Quadruped
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import velocity
from ksim_rl.transforms import ActionDelay, DelayCfg
from ksim_rl.transforms.transform_cfg import TransformCfg

ROBOT = Quadruped()
POSE = velocity.PoseStd(
    standing={".*_(roll|hip)": 0.05, ".*_knee": 0.1},
    walking={".*_(roll|hip)": 0.3, ".*_knee": 0.6},
    running={".*_(roll|hip)": 0.3, ".*_knee": 0.6},
)


def quadruped_velocity_flat() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return velocity.velocity_cfg(
        ROBOT,
        sim=velocity.sim(),
        feet=ContactSensor(geoms=ROBOT.foot_geoms),
        observations=velocity.observations(ROBOT),
        rewards=velocity.rewards(ROBOT, pose=POSE, foot_height=0.08),
        events=velocity.events(ROBOT) | {"foot_friction": velocity.foot_friction(ROBOT, low=0.3, high=1.2)},
        viewer=ViewerCfg(body=ROBOT.root_body, distance=1.6, elevation=-15.0, azimuth=120.0),
    )


def quadruped_velocity_delayed() -> ManagerBasedRlEnvCfg:
    """Return the same with actions that arrive up to 40 ms late, as on a robot's bus: each env draws its own lags."""
    lag = TransformCfg(ActionDelay, delay=DelayCfg(min_lag=0, max_lag=2))
    return dataclasses.replace(quadruped_velocity_flat(), transforms={"lag": lag})


TASK = Task(
    name="quadruped_velocity_flat",
    description="our quadruped follows a velocity command on flat ground",
    cfg=quadruped_velocity_flat,
    training=velocity.training(num_iterations=2_000),
)
DELAYED = Task(
    name="quadruped_velocity_delayed",
    description="our quadruped follows a velocity command with actions that arrive late",
    cfg=quadruped_velocity_delayed,
    training=velocity.training(num_iterations=2_000),
)
