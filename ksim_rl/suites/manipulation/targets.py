"""These terms move the targets of position servos by small steps, start them where joints are, and observe them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.envs.term import ActionTerm, EventTerm, ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import OfJoints
from ksim_rl.transforms.elementwise import clipped

REACH = (-1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class MoveTargets(OfJoints, ActionTerm):
    """Targets of joints, rad or m, change by `scale` times the action in [-1, 1], and stay in the joints' limits.

    Unlike `RelativeJointPositionAction` they go on from the targets before, not from where the joints are.
    """

    scale: Positive

    def size(self, view: EnvView) -> int:
        return len(view.joints(self.joints))

    def bounds(self, view: EnvView) -> Float[Tensor, "K 2"]:
        # The raw action is clipped to these bounds, whatever the scale.
        return constant(REACH, view.device).expand(self.size(view), 2)

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        # From the last target, so that steps add up even while the servo lags behind.
        target_EK = JointTarget(joints=self.joints)(view) + self.scale * clipped(action_EK, REACH)
        # With a limit factor below 1 targets stay clear of the joints' ends.
        low_K, high_K = view.joints(self.joints).soft_limits_L2.unbind(-1)
        view.write_joint_pos_target(self.joints, torch.clamp(target_EK, low_K, high_K))


@dataclass(frozen=True, kw_only=True)
class TargetsAtJoints(OfJoints, EventTerm):
    """Rows that reset are asked for where their joints are; it stands behind the events that put them there."""

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        # Rows that go on keep their targets.
        held_EK = JointTarget(joints=self.joints)(view)
        target_EK = torch.where(mask_E[:, None], view.joints(self.joints).encoder_pos_EL, held_EK)
        view.write_joint_pos_target(self.joints, target_EK)


@dataclass(frozen=True, kw_only=True)
class JointTarget(OfJoints, ObservationTerm):
    """Targets of joints, rad or m, [E, K]; with `relative` minus where the joints are (position stage)."""

    relative: bool = False

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        joints = view.joints(self.joints)
        # The view's buffer holds all joints, in the model's order.
        target_EK = view.joint_pos_target_EL[:, joints.index]
        if self.relative:
            return target_EK - joints.pos_EL
        return target_EK
