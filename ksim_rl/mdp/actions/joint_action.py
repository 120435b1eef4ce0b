"""Actions on joints turn a raw action into a number per joint; this is their base."""

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
