"""A planar robot with a hind and a fore leg runs; see `planar`."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.rewards.tolerance import tolerance
from ksim_rl.scene.robots.control_models import Cheetah
from ksim_rl.tasks import planar

RUN_SPEED = 8.0


@dataclass(frozen=True, kw_only=True)
class CheetahReward(RewardTerm):
    """Forward speed over `RUN_SPEED`, clipped to [0, 1]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        speed_E = planar.forward_speed(view)
        return tolerance(speed_E, low=RUN_SPEED, margin=RUN_SPEED, value_at_margin=0.0, shape="linear")


def cheetah_run() -> ManagerBasedRlEnvCfg:
    """Return the config of running as fast as 8 m/s."""
    return planar.planar_cfg(
        Cheetah(), motors=Cheetah.joints, reward=CheetahReward(), decimation=2, step_dt=0.01, distance=3.5
    )


RUN = Task(
    name="cheetah_run",
    description="a planar quadruped runs at 8 m/s",
    cfg=cheetah_run,
    training=planar.training(),
    solved_at=700.0,
)
