"""Our own quadruped gets up from any pose; nothing to download."""

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.robots.own_robots import Quadruped
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import get_up

ROBOT = Quadruped()


def quadruped_get_up() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return get_up.get_up_cfg(
        ROBOT,
        standing_height=0.29,
        drop_height=(0.12, 0.2),
        bend=0.6,
        action_scale={".*_roll": 0.4, ".*_(hip|knee)": 0.6},
        viewer=ViewerCfg(body=ROBOT.root_body, distance=1.6, elevation=-15.0, azimuth=120.0),
    )


TASK = Task(
    name="quadruped_get_up",
    description="our quadruped gets up from any pose",
    cfg=quadruped_get_up,
    training=get_up.training(num_iterations=1_000),
)
