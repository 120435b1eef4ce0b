"""These rewards rate joints, actuators and actions, left-right symmetry, and whether an episode goes on."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive, Within
from ksim_rl.checks import check_choice
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant, index_constant, values_by_name
from ksim_rl.mdp.fields import OfJoints, mechanical_power
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class JointLimitReward(OfJoints, RewardTerm):
    """Sum over joints of how far a size is above `soft_factor` of its limit, [E]; `limits` match each joint once."""

    limits: Mapping[str, Positive]
    soft_factor: Annotated[float, Within(low=0.0, high=1.0, low_open=True)] = 1.0

    def overshoot(self, view: EnvView, value_EL: Float[Tensor, "E L"]) -> Float[Tensor, " E"]:
        """Return the sum for the values of the joints."""
        # Patterns become one limit per joint, on the host and once.
        limit_L = values_by_name("limits", self.limits, view.joints(self.joints).names)
        free_L = constant([self.soft_factor * limit for limit in limit_L], view.device)
        # Symmetric about zero: speeds and efforts have one limit for both directions.
        return (value_EL.abs() - free_L).clamp(min=0.0).sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointPosLimits(OfJoints, RewardTerm):
    """Sum over joints of how far each is beyond its soft limits (`SceneCfg`), rad or m, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        joints = view.joints(self.joints)
        pos_EL = joints.pos_EL
        limits_L2 = joints.soft_limits_L2
        # The clamp cuts off the distance to the nearer limit; infinite limits cut nothing.
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
class JointJerkL2(OfJoints, RewardTerm):
    """Sum of squared jerks of joints, (rad/s^3)^2 or (m/s^3)^2, [E]: of velocities at three env steps, as a finite
    difference; 0 in the first two steps of an episode.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return second_difference(view, view.joints(self.joints).vel_EL).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class UnreachableTargetL2(OfJoints, RewardTerm):
    """Sum over joints of the square of how far a position target is out of reach, rad^2 or m^2, [E].

    In an env step of length t a joint gets `max_velocity` t + `max_acceleration` t^2 / 2 away from where it was when it
    began (rad/s and rad/s^2, or m). The part of the target beyond that is counted; 0 in the first step of an episode.
    Both limits are by regular expressions that match each joint once.
    """

    max_velocity: Mapping[str, NonNegative]
    max_acceleration: Mapping[str, NonNegative]

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        joints = view.joints(self.joints)
        speed_L = values_by_name("max_velocity", self.max_velocity, joints.names)
        acceleration_L = values_by_name("max_acceleration", self.max_acceleration, joints.names)
        step = view.step_dt
        pairs = zip(speed_L, acceleration_L, strict=True)
        reach_L = constant(
            [speed * step + acceleration * step**2 / 2 for speed, acceleration in pairs],
            view.device,
        )
        # Where the step began: the positions that this term saw last.
        last_EL = view.buffer("last_pos_EL", len(joints))
        asked_EL = (view.joint_pos_target_EL[:, joints.index] - last_EL).abs()
        last_EL.copy_(joints.pos_EL)
        beyond_E = (asked_EL - reach_L).clamp(min=0.0).square().sum(-1)
        # The first step has no position before it: the buffer's zero is not one.
        return torch.where(view.episode_step_E <= 1, 0.0, beyond_E)


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
        index = view.resolver.index("actuator", self.actuators)
        return view.world.actuator_force_EL[:, index].square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class Energy(OfJoints, RewardTerm):
    """Sum over joints of |effort * velocity|, W: braking costs as much as driving (`mechanical_power`)."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return mechanical_power(view, self.joints)


@dataclass(frozen=True, kw_only=True)
class Alive(RewardTerm):
    """1 in every step, [E]."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return torch.ones(view.num_envs, device=view.device)


@dataclass(frozen=True, kw_only=True)
class Terminated(RewardTerm):
    """1 in the step in which the episode ends by a failure, not by time, [E].

    With `scale_rewards_by_dt` the weight counts `step_dt` times. A world whose physics failed gets no reward at all.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.terminated_E.to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class ActionRateL2(RewardTerm):
    """|a_t - a_{t-1}|^2 of the policy's raw actions, [E]; the action before the first of an episode is 0."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (view.action_EL - view.last_action_EL).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class ActionAccelerationL2(RewardTerm):
    """|a_t - 2 a_{t-1} + a_{t-2}|^2 of the policy's raw actions, [E]; actions before an episode are 0."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # The env keeps the last action; the last rate is the term's own buffer.
        rate_EL = view.action_EL - view.last_action_EL
        return change(view, "last_rate_EL", rate_EL).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class ActionJerkL2(RewardTerm):
    """|a_t - 3 a_{t-1} + 3 a_{t-2} - a_{t-3}|^2 of the policy's raw actions, [E]; actions before an episode are 0."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # Third difference: change of rate, then change of acceleration, each with its own buffer.
        acceleration_EL = change(view, "last_rate_EL", view.action_EL - view.last_action_EL)
        return change(view, "last_acceleration_EL", acceleration_EL).square().sum(-1)


def change(view: EnvView, name: str, value_EL: Float[Tensor, "E L"]) -> Float[Tensor, "E L"]:
    """Return the change of a value since the last step, and remember the value."""
    # Zeroed at resets, so that an episode starts from a rate of 0.
    last_EL = view.buffer(name, value_EL.shape[-1])
    change_EL = value_EL - last_EL
    # In place and after the difference was taken.
    last_EL.copy_(value_EL)
    return change_EL


def second_difference(view: EnvView, value_EL: Float[Tensor, "E L"]) -> Float[Tensor, "E L"]:
    """Return the second derivative of a value by time over three env steps, 0 in the first two of an episode."""
    rate_EL = change(view, "last_value_EL", value_EL) / view.step_dt
    second_EL = change(view, "last_rate_EL", rate_EL) / view.step_dt
    # A buffer's zero is neither a value nor a rate: the first rate, and the first two changes of it, mean nothing.
    return torch.where(view.episode_step_E[:, None] <= 2, 0.0, second_EL)


@dataclass(frozen=True, kw_only=True)
class Symmetry(RewardTerm):
    """A reward of joints that mirror each other, left and right, pair by pair in the order that the patterns give.

    `signs` are 1 or -1 by regular expressions that match each left joint once: -1 where the mirror image turns the
    other way, as hip abduction does.
    """

    left: Patterns
    right: Patterns
    signs: Mapping[str, float] = field(default_factory=lambda: {".*": 1.0})

    def _check_fields(self) -> None:
        super()._check_fields()
        for pattern, sign in self.signs.items():
            check_choice(f"signs[{pattern!r}]", sign, (1.0, -1.0))

    def _pairs(self, view: EnvView) -> tuple[list[str], list[str]]:
        """Return the names of left and right joints, pair by pair."""
        left = view.joints(self.left).names
        right = view.joints(self.right).names
        # Pairs are by position in both lists, so that these must be as long.
        if len(left) != len(right):
            raise ValueError(
                f"left matches {left}, right matches {right}: give each left joint one right joint"
            )
        return left, right

    def _mismatch(self, view: EnvView, left_EP: Tensor, right_EP: Tensor) -> Tensor:
        """Return the sum over pairs of (left - sign * right)^2, [E]."""
        # Signs are given for left joints only.
        signs_P = constant(values_by_name("signs", self.signs, self._pairs(view)[0]), view.device)
        # One fused kernel for left - sign * right.
        return torch.addcmul(left_EP, signs_P, right_EP, value=-1.0).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointSymmetryL2(Symmetry):
    """Sum over pairs of (x_left - sign x_right)^2, `x` from the default pose, rad^2 or m^2, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        left, right = self._pairs(view)
        return self._mismatch(view, view.joints(left).pos_rel_EL, view.joints(right).pos_rel_EL)


@dataclass(frozen=True, kw_only=True)
class ActionSymmetryL2(Symmetry):
    """Sum over pairs of (a_left - sign a_right)^2 of raw actions, [E]; `joints` are the joints of the first columns."""

    joints: Patterns

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        names = view.joints(self.joints).names
        columns = []
        # Columns of the action, found by name in the order of the action's joints.
        for side in self._pairs(view):
            missing = [name for name in side if name not in names]
            if missing:
                raise ValueError(
                    f"joints={self.joints!r}: {missing[0]!r} of a pair is not among them: {names}"
                )
            columns.append(index_constant([names.index(name) for name in side], view.device))
        left, right = columns
        return self._mismatch(view, view.action_EL[:, left], view.action_EL[:, right])
