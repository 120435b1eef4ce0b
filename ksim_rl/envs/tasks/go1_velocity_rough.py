"""Unitree Go1 follows a velocity command over stairs, slopes and rough ground that get harder as it learns."""

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.tasks import velocity, velocity_rough
from ksim_rl.envs.tasks.go1_velocity_flat import FEET, FOOT_FRICTION, POSE, ROBOT, SIM, VIEWER


def go1_velocity_rough() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return velocity_rough.velocity_rough_cfg(
        ROBOT,
        sim=velocity_rough.with_room(SIM, njmax=160, nconmax=48),
        feet=FEET,
        rewards=velocity.rewards(ROBOT, pose=POSE),
        events=velocity.events(ROBOT) | FOOT_FRICTION,
        viewer=VIEWER,
        root_height=ROBOT.init_pos[2],
    )


TASK = Task(
    name="go1_velocity_rough",
    description="Unitree Go1 follows a velocity command over stairs, slopes and rough ground",
    cfg=go1_velocity_rough,
    training=velocity.training(num_iterations=10_000),
)
