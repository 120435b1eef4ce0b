"""Each of these observations has one block for each body that its names match."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.observations.framed_observation import FramedObservation
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class BodyObservation(FramedObservation):
    """What the terms of this file share.

    Attributes:
        bodies: names or regular expressions.
    """

    bodies: Patterns


@dataclass(frozen=True, kw_only=True)
class BodyPos(BodyObservation):
    """Positions of body frames, m, [E, 3N]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.points(view, view.bodies(self.bodies).pos_EN3)


@dataclass(frozen=True, kw_only=True)
class BodyQuat(BodyObservation):
    """Orientations of bodies, (w, x, y, z), [E, 4N]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        quat_EN4 = view.bodies(self.bodies).quat_EN4
        if self.frame == "root":
            root_E14 = view.entity(self.entity).root_quat_EL[:, None]
            quat_EN4 = quaternion.multiply(quaternion.conjugate(root_E14), quat_EN4)
        return quat_EN4.flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class BodyRotation6d(BodyObservation):
    """The x axis, then the y axis, of each body, [E, 6N]; position stage.

    Orientations without jumps (Zhou et al. 2019).
    """

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        axes_EN23 = view.bodies(self.bodies).axes_EN33[:, :, :2]
        return self.vectors(view, axes_EN23.flatten(start_dim=1, end_dim=2))


@dataclass(frozen=True, kw_only=True)
class BodyLinVel(BodyObservation):
    """Linear velocities of body frame origins, m/s, [E, 3N]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.vectors(view, view.bodies(self.bodies).lin_vel_EN3)


@dataclass(frozen=True, kw_only=True)
class BodyAngVel(BodyObservation):
    """Angular velocities of bodies, rad/s, [E, 3N]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.vectors(view, view.bodies(self.bodies).ang_vel_EN3)


@dataclass(frozen=True, kw_only=True)
class CenterOfMassPos(BodyObservation):
    """Centre of mass of each body with all that hangs on it, m, [E, 3N]; position stage. The root's is the robot's."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.points(view, view.bodies(self.bodies).subtree_com_pos_EN3)


@dataclass(frozen=True, kw_only=True)
class CenterOfMassVel(BodyObservation):
    """Velocity of the centre of mass of each body with all that hangs on it, m/s, [E, 3N]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.vectors(view, view.bodies(self.bodies).subtree_com_vel_EN3)
