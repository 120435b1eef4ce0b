"""These terms map actions to targets of joints or controls of actuators."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive, Range
from ksim_rl.envs.term import ActionTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant, values_by_name
from ksim_rl.scene.names import Patterns
from ksim_rl.transforms.elementwise import clipped
from ksim_rl.transforms.low_pass import smoothing

PerJoint = float | Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class JointAction(ActionTerm):
    """An action with one column per joint, in the order of `joints`; the actuators may stand in any order.

    A raw action is clipped, squashed, scaled, filtered and shifted, in this order; each is left out by default. These
    belong to this term and may differ by joint (keys are regular expressions); clip, scale and filter work as in the
    transforms `ActionClip`, `ActionScale` and `ActionLowPass`, which treat a whole action alike, in any env.
    """

    joints: Patterns
    scale: PerJoint = 1.0
    """Units of the target per unit action."""
    offset: PerJoint = 0.0
    """In the target's units."""
    clip: Range | None = None
    tanh: bool = False
    """Squashes the action into (-1, 1)."""
    cutoff_hz: Positive | None = None
    """Of a first-order low-pass filter. After a reset it starts at 0, as if there were no action."""

    def size(self, view: EnvView) -> int:
        return len(view.joints(self.joints))

    def bounds(self, view: EnvView) -> Float[Tensor, "K 2"] | None:
        if self.clip is None:
            return None
        # Bounds are of the raw action, which is clipped first: the scale plays no part.
        return constant(self.clip, view.device).expand(self.size(view), 2)

    def shaped(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> Float[Tensor, "E K"]:
        """Return the action after clip, tanh, scale, filter and offset."""
        scaled_EK = self.scaled(view, action_EK, "scale", self.scale)
        offset = per_joint(view, "offset", self.offset, self.joints)
        # The usual case, which is worth no kernel.
        if isinstance(offset, float) and offset == 0.0:
            return scaled_EK
        return scaled_EK + offset

    def scaled(
        self, view: EnvView, action_EK: Float[Tensor, "E K"], field: str, scale: PerJoint
    ) -> Float[Tensor, "E K"]:
        """Return the action after clip, tanh, a scale (the field of that name) and the filter."""
        # The clip comes first: it bounds the policy's output, not the target.
        if self.clip is not None:
            action_EK = clipped(action_EK, self.clip)
        if self.tanh:
            action_EK = torch.tanh(action_EK)
        action_EK = action_EK * per_joint(view, field, scale, self.joints)
        if self.cutoff_hz is None:
            return action_EK
        # The field's name in the buffer's keeps two filters of one term apart
        # (`JointPositionVelocityAction`).
        filtered_EK = view.buffer(f"filtered_{field}_EK", action_EK.shape[1])
        # In place: the buffer is the state of the filter.
        return filtered_EK.lerp_(action_EK, smoothing(self.cutoff_hz, view.step_dt))


def per_joint(
    view: EnvView, field: str, value: PerJoint, joints: Patterns
) -> float | Float[Tensor, " K"]:
    """Return the number for all joints, or those by joint."""
    if not isinstance(value, Mapping):
        return float(value)
    # Patterns are resolved to one number per column, in policy order.
    return constant(values_by_name(field, value, view.joints(joints).names), view.device)


@dataclass(frozen=True, kw_only=True)
class JointPositionAction(JointAction):
    """Positions (rad or m): the shaped action, relative to the default pose unless `use_default_offset=False`."""

    use_default_offset: bool = True

    def target(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> Float[Tensor, "E K"]:
        """Return the positions that an action asks for."""
        target_EK = self.shaped(view, action_EK)
        if self.use_default_offset:
            return target_EK + view.joints(self.joints).default_pos_EL
        return target_EK

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        view.write_joint_pos_target(self.joints, self.target(view, action_EK))


@dataclass(frozen=True, kw_only=True)
class RelativeJointPositionAction(JointAction):
    """Positions (rad or m): the shaped action, relative to the encoders' readings when the env step begins."""

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        # Measured positions, not the last targets: errors of tracking do not add up.
        now_EK = view.joints(self.joints).encoder_pos_EL
        view.write_joint_pos_target(self.joints, now_EK + self.shaped(view, action_EK))


@dataclass(frozen=True, kw_only=True)
class JointVelocityAction(JointAction):
    """Velocities (rad/s or m/s): the shaped action."""

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        view.write_joint_vel_target(self.joints, self.shaped(view, action_EK))


@dataclass(frozen=True, kw_only=True)
class JointEffortAction(JointAction):
    """Efforts, N m or N, inside each motor's control range; a motor of the MJCF multiplies it by its gear and gain."""

    joints: Patterns = ".*"

    def bounds(self, view: EnvView) -> Float[Tensor, "K 2"] | None:
        own_K2 = super().bounds(view)
        limits_K2 = view.targets.limits("effort", self.joints)
        # The inverse below is linear, and does not hold behind a tanh.
        if limits_K2 is None or self.tanh:
            return own_K2
        scale = per_joint(view, "scale", self.scale, self.joints)
        offset = per_joint(view, "offset", self.offset, self.joints)
        # Solve limit = scale * action + offset for the action; a negative scale swaps both ends, hence the
        # sort.
        range_K2 = ((limits_K2.T - offset) / scale).T.sort(dim=-1).values
        if own_K2 is None:
            return range_K2
        # With a clip as well, the narrower of both bounds holds.
        return range_K2.clamp(own_K2[:, :1], own_K2[:, 1:])

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        view.write_joint_effort_target(self.joints, self.shaped(view, action_EK))


@dataclass(frozen=True, kw_only=True)
class JointPositionVelocityAction(JointPositionAction):
    """Positions of all joints, then velocities; clip, tanh and filter hold for both, scale and offset for positions."""

    velocity_scale: PerJoint = 1.0
    """rad/s or m/s per unit action."""

    def size(self, view: EnvView) -> int:
        return 2 * super().size(view)

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        # Columns are positions [E, K], then velocities [E, K], in the same order of joints.
        pos_EK, vel_EK = action_EK.chunk(2, dim=1)
        super().__call__(view, pos_EK)
        # Without the offset, which is a position.
        view.write_joint_vel_target(
            self.joints, self.scaled(view, vel_EK, "velocity_scale", self.velocity_scale)
        )


@dataclass(frozen=True, kw_only=True)
class ActuatorAction(ActionTerm):
    """Controls of actuators as they are (tendons, sites, muscles, grippers): scale * action + offset, one column each.

    They stay inside each control range. Scale and offset are numbers, or by regular expressions on actuators' names.
    """

    actuators: Patterns
    scale: PerJoint = 1.0
    offset: PerJoint = 0.0

    def size(self, view: EnvView) -> int:
        ids = view.resolver.ids("actuator", self.actuators)
        # A law that writes these controls before each substep would overwrite the action in silence.
        view.targets.check_no_law(ids)
        return len(ids)

    def numbers(
        self, view: EnvView, field: Literal["scale", "offset"]
    ) -> float | Float[Tensor, " K"]:
        """Return the scale or the offset: the number for all actuators, or those by column."""
        value = getattr(self, field)
        if not isinstance(value, Mapping):
            return float(value)
        names = view.resolver.names("actuator")
        chosen = [names[i] for i in view.resolver.ids("actuator", self.actuators)]
        return constant(values_by_name(field, value, chosen), view.device)

    def bounds(self, view: EnvView) -> Float[Tensor, "K 2"] | None:
        limits_K2 = view.ctrl_limits_L2[view.resolver.index("actuator", self.actuators)]
        # Columns last, to broadcast over actuators; a negative scale swaps both ends, hence the sort.
        actions_2K = (limits_K2.T - self.numbers(view, "offset")) / self.numbers(view, "scale")
        return actions_2K.T.sort(dim=-1).values

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        index = view.resolver.index("actuator", self.actuators)
        limits_K2 = view.ctrl_limits_L2[index]
        asked_EK = action_EK * self.numbers(view, "scale") + self.numbers(view, "offset")
        # Clamped here, so that `ctrl` reads as the control in force.
        low_K, high_K = limits_K2.unbind(-1)
        view.world.ctrl_EL[:, index] = torch.clamp(asked_EK, low_K, high_K)
