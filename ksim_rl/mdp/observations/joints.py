"""These observations read joints and actuators, one column each in the order of the term's patterns."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import OfJoints
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class EncodedJoints(OfJoints, ObservationTerm):
    """A reading of joint positions.

    Attributes:
        biased: add the encoders' bias (`RandomizeEncoderBias`), as the robot itself would read them.
    """

    biased: bool = False

    def read(self, view: EnvView, pos_EL: Float[Tensor, "E L"]) -> Float[Tensor, "E L"]:
        """Return what encoders read at these positions of the joints."""
        return pos_EL + view.joints(self.joints).encoder_bias_EL if self.biased else pos_EL


@dataclass(frozen=True, kw_only=True)
class JointPos(EncodedJoints):
    """Positions of joints, rad or m; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.read(view, view.joints(self.joints).pos_EL)


@dataclass(frozen=True, kw_only=True)
class JointPosRel(EncodedJoints):
    """Positions of joints minus the default pose, rad or m; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.read(view, view.joints(self.joints).pos_rel_EL)


@dataclass(frozen=True, kw_only=True)
class JointVel(OfJoints, ObservationTerm):
    """Velocities of joints, rad/s or m/s, [E, L]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.joints(self.joints).vel_EL


@dataclass(frozen=True, kw_only=True)
class JointAcc(OfJoints, ObservationTerm):
    """Accelerations of joints, rad/s^2 or m/s^2, [E, L]; acceleration stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.joints(self.joints).acc_EL


@dataclass(frozen=True, kw_only=True)
class JointEffort(OfJoints, ObservationTerm):
    """What the actuators exert on joints, behind their gears, N m or N, [E, L]; acceleration stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.joints(self.joints).effort_EL


@dataclass(frozen=True, kw_only=True)
class ActuatorForce(ObservationTerm):
    """Forces of actuators, before their gears, N or N m, [E, L]; acceleration stage."""

    actuators: Patterns = ".*"

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.world.actuator_force_EL[:, view.resolver.index("actuator", self.actuators)]
