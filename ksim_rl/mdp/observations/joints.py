"""Observation terms of joints and actuators, float32 [E, L].

Joints (hinges and slides) come in the order of the term's `joints`; ".*" is the model's order. The same holds for
`actuators`.
"""

from dataclasses import dataclass

from torch import Tensor

from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.joints import Joints


@dataclass(frozen=True, kw_only=True)
class JointPos(ObservationTerm):
    """Positions of joints, rad or m, [E, L]; position stage.

    Attributes:
        biased: add the encoders' bias (`RandomizeEncoderBias`), as the robot itself would read them.
    """

    joints: Patterns = ".*"
    biased: bool = False

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        joints = view.joints(self.joints)
        return _with_bias(joints, joints.pos_EL, self.biased)


@dataclass(frozen=True, kw_only=True)
class JointPosRel(ObservationTerm):
    """Positions of joints minus the default pose, rad or m, [E, L]; position stage.

    Attributes:
        biased: add the encoders' bias (`RandomizeEncoderBias`), as the robot itself would read them.
    """

    joints: Patterns = ".*"
    biased: bool = False

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        joints = view.joints(self.joints)
        return _with_bias(joints, joints.pos_rel_EL, self.biased)


@dataclass(frozen=True, kw_only=True)
class JointVel(ObservationTerm):
    """Velocities of joints, rad/s or m/s, [E, L]; velocity stage."""

    joints: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.joints(self.joints).vel_EL


@dataclass(frozen=True, kw_only=True)
class JointAcc(ObservationTerm):
    """Accelerations of joints, rad/s^2 or m/s^2, [E, L]; acceleration stage."""

    joints: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.joints(self.joints).acc_EL


@dataclass(frozen=True, kw_only=True)
class JointEffort(ObservationTerm):
    """What the actuators exert on joints, behind their gears, N m or N, [E, L]; acceleration stage."""

    joints: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.joints(self.joints).effort_EL


@dataclass(frozen=True, kw_only=True)
class ActuatorForce(ObservationTerm):
    """Forces of actuators, before their gears, N or N m, [E, L]; acceleration stage."""

    actuators: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.world.actuator_force_EL[:, view.resolver.index("actuator", self.actuators)]


def _with_bias(joints: Joints, pos_EL: Tensor, biased: bool) -> Tensor:
    return pos_EL + joints.encoder_bias_EL if biased else pos_EL
