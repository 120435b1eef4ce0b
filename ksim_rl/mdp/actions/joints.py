"""These terms map actions to what joints or actuators are asked for."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.term import ActionTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.actions.joint_action import JointAction, PerJoint
from ksim_rl.scene.names import Patterns


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
