"""These rewards rate what joints and actuators do; weights are usually negative.

Positions and velocities are of the current state; accelerations, efforts and forces belong to the last physics substep
(acceleration stage).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive, Within
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant, values_by_name
from ksim_rl.mdp.fields import OfJoints
from ksim_rl.mdp.quantities import mechanical_power
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class JointLimitReward(OfJoints, RewardTerm):
    """Sum over joints of how far the size of something is above `soft_factor` of its limit, [E].

    Attributes:
        limits: by joint, in the unit of what is limited; keys are regular expressions that match each of `joints` once.
        soft_factor: fraction of the limit that is free of penalty.
    """

    limits: Mapping[str, Positive]
    soft_factor: Annotated[float, Within(low=0.0, high=1.0, low_open=True)] = 1.0

    def overshoot(self, view: EnvView, value_EL: Float[Tensor, "E L"]) -> Float[Tensor, " E"]:
        """Return the sum for the values of the joints."""
        limit_L = values_by_name("limits", self.limits, view.joints(self.joints).names)
        free_L = constant([self.soft_factor * limit for limit in limit_L], view.device)
        return (value_EL.abs() - free_L).clamp(min=0.0).sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointPosLimits(OfJoints, RewardTerm):
    """Sum over joints of how far each is beyond its soft limits, rad or m, [E]; position stage.

    Soft limits: `scene.soft_joint_pos_limit_factor` of the range, about its middle.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        joints = view.joints(self.joints)
        pos_EL, limits_L2 = joints.pos_EL, joints.soft_limits_L2
        inside_EL = torch.clamp(pos_EL, limits_L2[:, 0], limits_L2[:, 1])
        return (pos_EL - inside_EL).abs().sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointDeviationL1(OfJoints, RewardTerm):
    """Sum of |q - q0| from the default pose, rad or m, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.joints(self.joints).pos_rel_EL.abs().sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointDeviationL2(OfJoints, RewardTerm):
    """Sum of (q - q0)^2 from the default pose, rad^2 or m^2, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.joints(self.joints).pos_rel_EL.square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointVelL2(OfJoints, RewardTerm):
    """Sum of squared joint velocities, (rad/s)^2 or (m/s)^2, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.joints(self.joints).vel_EL.square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointVelLimits(JointLimitReward):
    """Sum over joints of how far each speed is above `soft_factor` of its limit, rad/s or m/s, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.overshoot(view, view.joints(self.joints).vel_EL)


@dataclass(frozen=True, kw_only=True)
class JointAccL2(OfJoints, RewardTerm):
    """Sum of squared joint accelerations, (rad/s^2)^2 or (m/s^2)^2, [E]; acceleration stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.joints(self.joints).acc_EL.square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointEffortL2(OfJoints, RewardTerm):
    """Sum of squared efforts (torques) of the actuators at joints, (N m)^2 or N^2, [E]; acceleration stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.joints(self.joints).effort_EL.square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointEffortLimits(JointLimitReward):
    """Sum over joints of how far each effort is above `soft_factor` of its limit, N m or N, [E]; acceleration stage.

    Actuators that clamp at their limit never exceed it: there, choose a factor below 1.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.overshoot(view, view.joints(self.joints).effort_EL)


@dataclass(frozen=True, kw_only=True)
class ActuatorForceL2(RewardTerm):
    """Sum of squared actuator forces, before the gears, N^2 or (N m)^2, [E]; acceleration stage."""

    actuators: Patterns = ".*"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (
            view.world.actuator_force_EL[:, view.resolver.index("actuator", self.actuators)].square().sum(-1)
        )


@dataclass(frozen=True, kw_only=True)
class Energy(OfJoints, RewardTerm):
    """Sum over joints of |effort * velocity|, W: braking costs as much as driving (`mechanical_power`)."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return mechanical_power(view, self.joints)
