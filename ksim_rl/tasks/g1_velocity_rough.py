"""Unitree G1 follows a velocity command over stairs, slopes and rough ground that get harder as it learns."""

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.tasks import velocity
from ksim_rl.tasks.g1_velocity_flat import ROBOT, g1_velocity_flat
from ksim_rl.tasks.velocity_rough import on_rough_ground


def g1_velocity_rough() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return on_rough_ground(g1_velocity_flat(), root_height=ROBOT.init_pos[2], njmax=250, nconmax=80)


TASK = Task(
    name="g1_velocity_rough",
    description="Unitree G1 follows a velocity command over stairs, slopes and rough ground",
    cfg=g1_velocity_rough,
    training=velocity.training(num_iterations=30_000),
)
