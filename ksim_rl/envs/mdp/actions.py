"""Maps from actions to actuator controls."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.checks import check_in_range, check_pair
from ksim_rl.envs.mdp.constants import constant, values_by_name
from ksim_rl.envs.names import Patterns
from ksim_rl.envs.term import ActionTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class JointPositionAction(ActionTerm):
    """Targets for position servos: `scale * action`, relative to the default pose unless `use_default_offset=False`.

    One column per joint, in the order of `joints`; the actuators that drive them may stand in any order.

    Attributes:
        joints: names or patterns.
        scale: rad or m per unit action, one for all or by joint (keys are regular expressions).
        clip: bounds of the action before scaling, or None.
    """

    joints: Patterns
    scale: float | Mapping[str, float] = 1.0
    use_default_offset: bool = True
    clip: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.scale, Mapping):
            check_in_range("scale", self.scale)
        if self.clip is not None:
            check_pair("clip", self.clip)

    def size(self, view: EnvView) -> int:
        """Return the number of joints."""
        return len(view.joint_names(self.joints))

    def __call__(self, view: EnvView, action_EK: Tensor) -> None:
        """Write the servo targets."""
        if self.clip is not None:
            action_EK = action_EK.clamp(*self.clip)
        target_EK = action_EK * self._scale(view)
        if self.use_default_offset:
            target_EK = target_EK + view.default_joint_pos_EL[:, view.joints(self.joints)]
        view.write_ctrl(view.resolver.actuators_of_joints(self.joints), target_EK)

    def _scale(self, view: EnvView) -> float | Tensor:
        if not isinstance(self.scale, Mapping):
            return self.scale
        return constant(values_by_name("scale", self.scale, view.joint_names(self.joints)), view.device)


@dataclass(frozen=True, kw_only=True)
class JointEffortAction(ActionTerm):
    """Controls of the motors that drive joints: `scale * action`, kept inside each motor's control range.

    One column per joint, in the order of `joints`. The force is the control times the motor's gear and gain.

    Attributes:
        joints: names or patterns.
        scale: control units per unit action.
    """

    joints: Patterns = ".*"
    scale: float = 1.0

    def __post_init__(self) -> None:
        check_in_range("scale", self.scale)

    def size(self, view: EnvView) -> int:
        """Return the number of joints."""
        return len(view.joint_names(self.joints))

    def __call__(self, view: EnvView, action_EK: Tensor) -> None:
        """Write the controls."""
        index = view.resolver.actuators_of_joints(self.joints)
        limits_K2 = view.ctrl_limits_L2[index]
        view.write_ctrl(index, torch.clamp(action_EK * self.scale, limits_K2[:, 0], limits_K2[:, 1]))
