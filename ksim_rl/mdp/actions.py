"""These terms map actions to what joints or actuators are asked for."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive, Range
from ksim_rl.envs.term import ActionTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant, values_by_name
from ksim_rl.scene.names import Patterns

PerJoint = float | Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class JointAction(ActionTerm):
    """An action with one column per joint, in the order of `joints`; the actuators may stand in any order.

    A raw action is clipped, squashed, scaled, filtered and shifted, in this order; each is left out by default. These
    belong to this term and may differ by joint; latency, and what treats the whole action alike in any env, are
    transforms of the task (`ActionDelay`, `ActionClip`, `ActionScale`, `ActionLowPass`).

    Attributes:
        joints: names or patterns.
        scale: units of the target per unit action, one for all or by joint (keys are regular expressions).
        offset: added at the end, in the target's units, one for all or by joint.
        clip: bounds of the raw action, or None.
        tanh: squashes the action into (-1, 1).
        cutoff_hz: corner frequency of a first-order low-pass filter, or None. At each env step it takes the part
            `1 - exp(-2 pi cutoff_hz step_dt)` of the way to the new value, as the continuous filter does under a
            constant input. After a reset it starts at 0, which is what no action at all asks for.
    """

    joints: Patterns
    scale: PerJoint = 1.0
    offset: PerJoint = 0.0
    clip: Range | None = None
    tanh: bool = False
    cutoff_hz: Positive | None = None

    def size(self, view: EnvView) -> int:
        return len(view.joints(self.joints))

    def shaped(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> Float[Tensor, "E K"]:
        """Return the action after clip, tanh, scale, filter and offset."""
        scaled_EK = self.scaled(view, action_EK, "scale", self.scale)
        offset = per_joint(view, "offset", self.offset, self.joints)
        return scaled_EK if isinstance(offset, float) and offset == 0.0 else scaled_EK + offset

    def scaled(
        self, view: EnvView, action_EK: Float[Tensor, "E K"], field: str, scale: PerJoint
    ) -> Float[Tensor, "E K"]:
        """Return the action after clip, tanh, a scale (the field of that name) and the filter."""
        if self.clip is not None:
            action_EK = action_EK.clamp(*self.clip)
        if self.tanh:
            action_EK = torch.tanh(action_EK)
        action_EK = action_EK * per_joint(view, field, scale, self.joints)
        if self.cutoff_hz is None:
            return action_EK
        filtered_EK = view.buffer(f"filtered_{field}_EK", action_EK.shape[1])
        return filtered_EK.lerp_(action_EK, 1.0 - math.exp(-2.0 * math.pi * self.cutoff_hz * view.step_dt))


def per_joint(view: EnvView, field: str, value: PerJoint, joints: Patterns) -> float | Float[Tensor, " K"]:
    """Return the number for all joints, or those by joint."""
    if not isinstance(value, Mapping):
        return float(value)
    return constant(values_by_name(field, value, view.joints(joints).names), view.device)


@dataclass(frozen=True, kw_only=True)
class JointPositionAction(JointAction):
    """Positions (rad or m): the shaped action, relative to the default pose unless `use_default_offset=False`."""

    use_default_offset: bool = True

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        target_EK = self.shaped(view, action_EK)
        if self.use_default_offset:
            target_EK = target_EK + view.joints(self.joints).default_pos_EL
        view.write_joint_pos_target(self.joints, target_EK)


@dataclass(frozen=True, kw_only=True)
class RelativeJointPositionAction(JointAction):
    """Positions (rad or m): the shaped action, relative to where the joints are when the env step begins."""

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        now_EK = view.joints(self.joints).pos_EL
        view.write_joint_pos_target(self.joints, now_EK + self.shaped(view, action_EK))


@dataclass(frozen=True, kw_only=True)
class JointVelocityAction(JointAction):
    """Velocities (rad/s or m/s): the shaped action."""

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        view.write_joint_vel_target(self.joints, self.shaped(view, action_EK))


@dataclass(frozen=True, kw_only=True)
class JointEffortAction(JointAction):
    """Efforts (N m or N): the shaped action, kept inside each motor's control range.

    A motor of the MJCF takes it as its control, which its gear and gain multiply.
    """

    joints: Patterns = ".*"

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        view.write_joint_effort_target(self.joints, self.shaped(view, action_EK))


@dataclass(frozen=True, kw_only=True)
class JointPositionVelocityAction(JointPositionAction):
    """Positions and velocities: first one column per joint for the positions, then as many for the velocities.

    Clip, tanh and filter hold for both; scale and offset are those of the positions.

    Attributes:
        velocity_scale: rad/s or m/s per unit action, one for all or by joint.
    """

    velocity_scale: PerJoint = 1.0

    def size(self, view: EnvView) -> int:
        return 2 * super().size(view)

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        pos_EK, vel_EK = action_EK.chunk(2, dim=1)
        super().__call__(view, pos_EK)
        view.write_joint_vel_target(
            self.joints, self.scaled(view, vel_EK, "velocity_scale", self.velocity_scale)
        )


@dataclass(frozen=True, kw_only=True)
class ActuatorAction(ActionTerm):
    """Controls of actuators as they are (tendons, muscles, grippers): the action, kept inside each control range.

    One column per actuator, in the order of `actuators`.

    Attributes:
        actuators: names or patterns.
        scale: control units per unit action.
    """

    actuators: Patterns
    scale: float = 1.0

    def size(self, view: EnvView) -> int:
        ids = view.resolver.ids("actuator", self.actuators)
        view.targets.check_no_law(ids)
        return len(ids)

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        index = view.resolver.index("actuator", self.actuators)
        limits_K2 = view.ctrl_limits_L2[index]
        view.write_ctrl(index, torch.clamp(action_EK * self.scale, limits_K2[:, 0], limits_K2[:, 1]))
