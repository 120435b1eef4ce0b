"""A one-legged planar robot stands and hops; see `planar`."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.rewards.tolerance import tolerance
from ksim_rl.scene.robots.control_models import Hopper
from ksim_rl.tasks import planar

STAND_HEIGHT = 0.7
"""m from the foot to the torso; standing at rest gives 0.81."""
HOP_SPEED = 1.5


@dataclass(frozen=True, kw_only=True)
class HopperReward(RewardTerm):
    """tall * fast, or tall * (4 + small effort) / 5 without a speed, in [0, 1]; position and velocity stage.

    "tall" is 1 where the torso is `STAND_HEIGHT` above the foot, which holds in flight too, and where it is upright;
    "fast" rates the forward speed against `speed`.

    Attributes:
        speed: m/s, from which on the robot is fast enough; 0 only asks it to stand.
    """

    speed: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        foot_E = view.body("foot").pos_EL[:, 2]
        tall_E = tolerance(planar.height(view) - foot_E, low=STAND_HEIGHT, margin=STAND_HEIGHT / 2)
        stand_E = tall_E * planar.upright(view)
        if self.speed == 0.0:
            return stand_E * (4.0 + planar.small_effort(view)) / 5.0
        fast_E = tolerance(
            planar.forward_speed(view), low=self.speed, margin=self.speed, value_at_margin=0.0, shape="linear"
        )
        return stand_E * fast_E


def _cfg(speed: float) -> ManagerBasedRlEnvCfg:
    return planar.planar_cfg(
        Hopper(),
        motors=Hopper.joints,
        reward=HopperReward(speed=speed),
        decimation=4,
        step_dt=0.02,
        distance=3.5,
    )


def hopper_stand() -> ManagerBasedRlEnvCfg:
    """Return the config of balancing on one leg."""
    return _cfg(0.0)


def hopper_hop() -> ManagerBasedRlEnvCfg:
    """Return the config of hopping forward at 1.5 m/s or faster."""
    return _cfg(HOP_SPEED)


STAND = Task(
    name="hopper_stand",
    description="a one-legged planar robot balances",
    cfg=hopper_stand,
    training=planar.training(),
    solved_at=900.0,
)
HOP = Task(
    name="hopper_hop",
    description="a one-legged planar robot hops forward at 1.5 m/s",
    cfg=hopper_hop,
    training=planar.training(num_iterations=1000),
)
