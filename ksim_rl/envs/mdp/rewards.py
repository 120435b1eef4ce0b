"""Rewards that any robot can use. Others: `rewards_tracking`, `rewards_posture`, `rewards_feet`."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.envs.names import Patterns
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class Alive(RewardTerm):
    """1 in every step, [E]."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        return torch.ones(view.num_envs, device=view.device)


@dataclass(frozen=True, kw_only=True)
class ActionRateL2(RewardTerm):
    """|a_t - a_{t-1}|^2 of the policy's raw actions, [E]; the action before the first of an episode is 0."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        return (view.action_EL - view.last_action_EL).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointVelL2(RewardTerm):
    """Sum of squared joint velocities, (rad/s)^2 or (m/s)^2, [E]; velocity stage."""

    joints: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        return view.joint_vel_EL[:, view.joints(self.joints)].square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class ActuatorForceL2(RewardTerm):
    """Sum of squared actuator forces, N^2 or (N m)^2, [E]; acceleration stage."""

    actuators: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the unweighted reward, [E]."""
        return view.world.actuator_force_EL[:, view.actuators(self.actuators)].square().sum(-1)
