"""Our own humanoid gets up from any pose; nothing to download."""

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.scene.robots.own_robots import Humanoid
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import get_up

ROBOT = Humanoid()


def humanoid_get_up() -> ManagerBasedRlEnvCfg:
    """Return the config."""
    return get_up.get_up_cfg(
        ROBOT,
        standing_height=0.48,
        drop_height=(0.05, 0.15),
        bend=0.6,
        action_scale={".*": 0.7},
        viewer=ViewerCfg(body=ROBOT.root_body, distance=2.2, elevation=-12.0, azimuth=130.0),
    )


TASK = Task(
    name="humanoid_get_up",
    description="our humanoid gets up from any pose",
    cfg=humanoid_get_up,
    training=get_up.training(num_iterations=3_000),
)
