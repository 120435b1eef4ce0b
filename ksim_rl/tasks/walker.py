"""A two-legged planar robot stands, walks and runs; see `planar`."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.rewards.tolerance import tolerance
from ksim_rl.scene.robots.control_models import Walker
from ksim_rl.tasks import planar

STAND_HEIGHT = 1.15
WALK_SPEED, RUN_SPEED = 1.0, 5.0


@dataclass(frozen=True, kw_only=True)
class WalkerReward(RewardTerm):
    """(3 tall + upright) / 4 * (5 fast + 1) / 6, in [0, 1]; position and velocity stage.

    "tall" rates the torso's height against `STAND_HEIGHT`, "fast" the forward speed against `speed`. Standing alone
    gives 1 where no speed is asked, else 1/6.

    Attributes:
        speed: m/s, from which on the robot is fast enough; 0 only asks it to stand.
    """

    speed: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        tall_E = tolerance(planar.height(view), low=STAND_HEIGHT, margin=STAND_HEIGHT / 2)
        stand_E = (3.0 * tall_E + planar.upright(view)) / 4.0
        if self.speed == 0.0:
            return stand_E
        fast_E = tolerance(
            planar.forward_speed(view),
            low=self.speed,
            margin=self.speed / 2,
            value_at_margin=0.5,
            shape="linear",
        )
        return stand_E * (5.0 * fast_E + 1.0) / 6.0


def _cfg(speed: float) -> ManagerBasedRlEnvCfg:
    return planar.planar_cfg(
        Walker(),
        motors=Walker.joints,
        reward=WalkerReward(speed=speed),
        decimation=5,
        step_dt=0.025,
        distance=4.0,
    )


def walker_stand() -> ManagerBasedRlEnvCfg:
    """Return the config of standing upright."""
    return _cfg(0.0)


def walker_walk() -> ManagerBasedRlEnvCfg:
    """Return the config of walking at 1 m/s or faster."""
    return _cfg(WALK_SPEED)


def walker_run() -> ManagerBasedRlEnvCfg:
    """Return the config of running at 5 m/s or faster."""
    return _cfg(RUN_SPEED)


STAND = Task(
    name="walker_stand",
    description="a planar biped stands upright",
    cfg=walker_stand,
    training=planar.training(),
    solved_at=950.0,
)
WALK = Task(
    name="walker_walk",
    description="a planar biped walks at 1 m/s",
    cfg=walker_walk,
    training=planar.training(),
    solved_at=900.0,
)
RUN = Task(
    name="walker_run",
    description="a planar biped runs at 5 m/s",
    cfg=walker_run,
    training=planar.training(num_iterations=1000),
)
