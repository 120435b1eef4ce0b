"""Unitree Go1 follows a velocity command over stairs, slopes and rough ground that get harder as it learns."""

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.tasks import velocity
from ksim_rl.tasks.go1_velocity_flat import ROBOT, go1_velocity_flat
from ksim_rl.tasks.velocity_rough import on_rough_ground


def go1_velocity_rough() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return on_rough_ground(go1_velocity_flat(), root_height=ROBOT.init_pos[2], njmax=120, nconmax=40)


TASK = Task(
    name="go1_velocity_rough",
    description="Unitree Go1 follows a velocity command over stairs, slopes and rough ground",
    cfg=go1_velocity_rough,
    training=velocity.training(num_iterations=10_000),
)
