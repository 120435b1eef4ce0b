"""A pole on a cart is balanced or swung up, with the figures of dm_control's suite.

Tassa et al., "DeepMind Control Suite" (2018): a 1 kg cart on a 3.6 m rail carries a 0.1 kg pole of 1 m; the force is
at most 10 N; control runs at 100 Hz for 10 s. The reward is a product of four factors in [0, 1], so that a return lies
in [0, 1000].
"""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl import mdp
from ksim_rl.checked import NonNegative, Within
from ksim_rl.data import DatasetCfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.task import Task
from ksim_rl.envs.term import EventTerm, ObservationTerm, RewardTerm, TerminationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.rewards.tracking import tolerance
from ksim_rl.scene.robots.control_models import Cartpole
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.tasks import small_networks
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg


@dataclass(frozen=True, kw_only=True)
class CartpolePosition(ObservationTerm):
    """Position of the cart, m, and cosine and sine of the pole's angle from upright, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        cart_E1, angle_E1 = view.joints("slider").pos_EL, view.joints("hinge").pos_EL
        return torch.cat((cart_E1, torch.cos(angle_E1), torch.sin(angle_E1)), dim=-1)


@dataclass(frozen=True, kw_only=True)
class CartpoleReward(RewardTerm):
    """dm_control's smooth reward: upright x centered x small control x small angular velocity, in [0, 1].

    A factor that rates x against a margin m is 0.1^((x/m)^2): 1 at 0 and 0.1 at the margin (see `tolerance`).
    """

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        cart_E = view.joints("slider").pos_EL[:, 0]
        angle_E = view.joints("hinge").pos_EL[:, 0]
        velocity_E = view.joints("hinge").vel_EL[:, 0]
        upright_E = (torch.cos(angle_E) + 1.0) / 2.0
        centered_E = (1.0 + tolerance(cart_E, low=0.0, high=0.0, margin=2.0)) / 2.0
        small_control_E = (4.0 + (1.0 - view.action_EL[:, 0].clamp(-1.0, 1.0).square())) / 5.0
        small_velocity_E = (1.0 + tolerance(velocity_E, low=0.0, high=0.0, margin=5.0)) / 2.0
        return upright_E * centered_E * small_control_E * small_velocity_E


@dataclass(frozen=True, kw_only=True)
class PoleFallen(TerminationTerm):
    """The pole is further than `limit` rad from upright."""

    limit: Annotated[float, Within(low=0.0, high=math.pi, low_open=True)]

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        return torch.cos(view.joints("hinge").pos_EL[:, 0]) < math.cos(self.limit)


@dataclass(frozen=True, kw_only=True)
class ResetCartpole(EventTerm):
    """Place cart and pole near a start pose.

    Attributes:
        cart_range: m; the cart starts uniformly within plus or minus this.
        angle: rad from upright; the middle of the pole's start.
        angle_range: rad; the pole starts uniformly within plus or minus this about `angle`.
        velocity_std: m/s and rad/s; both velocities start normally distributed.
    """

    cart_range: NonNegative
    angle: float
    angle_range: NonNegative
    velocity_std: NonNegative = 0.01

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        spread_EL = view.uniform(2, -1.0, 1.0)
        cart_E1 = spread_EL[:, :1] * self.cart_range
        angle_E1 = self.angle + spread_EL[:, 1:] * self.angle_range
        joints = view.joints(("slider", "hinge"))
        joints.write_pos(mask_E, torch.cat((cart_E1, angle_E1), dim=-1))
        joints.write_vel(mask_E, view.normal(2) * self.velocity_std)


def _cfg(reset: ResetCartpole, **terminations: TerminationTerm) -> ManagerBasedRlEnvCfg:
    terms = {
        "position": ObservationTermCfg(term=CartpolePosition()),
        "velocity": ObservationTermCfg(term=mdp.JointVel(joints=("slider", "hinge"))),
    }
    return ManagerBasedRlEnvCfg(
        decimation=1,
        scene=SceneCfg(robots={"cartpole": Cartpole()}, num_envs=1024),
        observations={"actor": ObservationGroupCfg(terms=terms), "critic": ObservationGroupCfg(terms=terms)},
        actions={"force": mdp.JointEffortAction(joints="slider")},
        events={"reset": reset},
        rewards={"balance": CartpoleReward()},
        terminations={"time_out": mdp.TimeOut(time_out=True), **terminations},
        episode_length_s=10.0,
        scale_rewards_by_dt=False,
        viewer=ViewerCfg(body="cart", distance=4.0, elevation=-10.0, azimuth=90.0),
    )


def cartpole_balance() -> ManagerBasedRlEnvCfg:
    """Return the config of keeping the pole up from a start near upright; unlike dm_control's, it ends with a fall."""
    reset = ResetCartpole(cart_range=0.1, angle=0.0, angle_range=0.034)
    return _cfg(reset, fallen=PoleFallen(limit=0.5))


def cartpole_swingup() -> ManagerBasedRlEnvCfg:
    """Return the config of swinging the pole up from hanging."""
    return _cfg(ResetCartpole(cart_range=0.02, angle=math.pi, angle_range=0.02))


BALANCE = Task(
    name="cartpole_balance",
    description="keep a pole upright on a cart",
    cfg=cartpole_balance,
    training=small_networks.training(
        num_envs=512,
        data=DatasetCfg(num_env_states_per_minibatch=2048, num_minibatches=8),
        num_iterations=120,
        learning_rate=1e-3,
        num_epochs=4,
        entropy_coeff=0.0,
    ),
    # Upright, centered and at rest with little force gives 1 per step for 1000 steps; 950 leaves half a second of that.
    solved_at=950.0,
)
SWINGUP = Task(
    name="cartpole_swingup",
    description="swing a hanging pole up and keep it upright",
    cfg=cartpole_swingup,
    training=small_networks.training(
        num_envs=256,
        data=DatasetCfg(num_env_states_per_minibatch=2048, num_minibatches=8),
        num_iterations=300,
        eval_interval=20,
        learning_rate=5e-4,
        num_epochs=8,
        gamma=0.995,
        entropy_coeff=0.003,
    ),
    # What a pole gives that is up, centered and at rest from 2 s on (800 of 1000 steps), with nothing before that.
    solved_at=800.0,
)
