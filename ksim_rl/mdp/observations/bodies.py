"""Each of these observations has one block for each body, site or contact that its names match.

Contacts and their forces are of the last physics substep (acceleration stage), in the order of the sensor's
elements; poses and velocities are of the current state.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.pose import OfTarget
from ksim_rl.mdp.fields import (
    FramedObservation,
    OfContacts,
    OfSensor,
    OfSites,
    SiteAndBody,
    contact_force,
)
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class BodyObservation(FramedObservation):
    """An observation of bodies by names or regular expressions."""

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
        # Conjugate of the root on the left: orientation relative to the root.
        if self.frame == "root":
            root_E14 = view.entity(self.entity).root_quat_EL[:, None]
            quat_EN4 = quaternion.multiply(quaternion.conjugate(root_E14), quat_EN4)
        return quat_EN4.flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class BodyRotation6d(BodyObservation):
    """The x axis, then the y axis, of each body, without jumps (Zhou et al. 2019), [E, 6N]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.rotations6d(view, view.bodies(self.bodies).axes_EN33)


@dataclass(frozen=True, kw_only=True)
class SiteRotation6d(OfSites, FramedObservation):
    """The x axis, then the y axis, of each site, without jumps (Zhou et al. 2019), [E, 6N]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.rotations6d(view, view.sites(self.sites).axes_EN33)


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


@dataclass(frozen=True, kw_only=True)
class CenterOfMassInertia(ObservationTerm):
    """Inertia of each body about the centre of mass of its whole tree, in the world's axes, [E, 10N]; position stage.

    MuJoCo's `cinert`, per body: moments xx, yy, zz, xy, xz, yz (kg m^2), mass times the offset from that centre (kg m),
    and mass (kg). The body alone counts, without the bodies below it.
    """

    bodies: Patterns

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.bodies(self.bodies).inertia_EN10.flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class OffsetToBody(SiteAndBody, ObservationTerm):
    """Origin of a body minus a site, world frame, m, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        return self.offset(view)


@dataclass(frozen=True, kw_only=True)
class OffsetToCommand(OfTarget, ObservationTerm):
    """A commanded position minus where a body or site is, world frame, m, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        return self.offset(view)


@dataclass(frozen=True, kw_only=True)
class Contact(OfContacts, ObservationTerm):
    """1 where the net contact force exceeds a threshold, else 0, [E, N]; acceleration stage."""

    threshold: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, "E N"]:
        return (contact_force(view, self.sensor) > self.threshold).to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class ContactForce(OfSensor, FramedObservation):
    """Net contact forces, N, [E, 3N]; acceleration stage. MuJoCo's sign: weight on the ground reads negative z."""

    frame: Literal["root", "world"] = "world"

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.vectors(view, view.contact(self.sensor).force_EN3)


@dataclass(frozen=True, kw_only=True)
class FootPos(OfSites, FramedObservation):
    """Positions of sites, m, [E, 3F]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.points(view, view.sites(self.sites).pos_EN3)


@dataclass(frozen=True, kw_only=True)
class FootHeight(OfSites, ObservationTerm):
    """Heights of sites above the ground right below them, m, [E, F]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.sites(self.sites).height_EN


@dataclass(frozen=True, kw_only=True)
class FootAirTime(OfSensor, ObservationTerm):
    """Seconds since each foot left the ground, 0 while it touches, [E, F]; acceleration stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.contact(self.sensor).air_time_EN


@dataclass(frozen=True, kw_only=True)
class FootContact(OfSensor, ObservationTerm):
    """1 where a foot touches the ground, else 0, [E, F]; acceleration stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.contact(self.sensor).found_EN


@dataclass(frozen=True, kw_only=True)
class FootContactForces(OfSensor, ObservationTerm):
    """Net force of each foot on the ground, world frame, sign(f) log(1 + |f|) of newtons, [E, 3F]; acceleration stage.

    MuJoCo's sign: a foot that stands presses down, z is negative.
    The logarithm keeps an impact of hundreds of newtons in the range of the other observations.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        force_EL = view.contact(self.sensor).force_EN3.flatten(start_dim=1)
        return torch.sign(force_EL) * torch.log1p(torch.abs(force_EL))


@dataclass(frozen=True, kw_only=True)
class ContactReading(OfSensor, ObservationTerm):
    """One quantity of the contacts of a `ContactPoints` of `scene.sensors`, world frame, [E, N] or flat [E, 3N].

    "found" (1 or 0), "force" (N) and "torque" (N m) of the element on its partner, "distance" (m, negative inside),
    "position" (m) or "normal"; acceleration stage.
    """

    quantity: Literal["found", "force", "torque", "distance", "position", "normal"] = "force"

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        contacts = view.contact_points(self.sensor)
        if self.quantity in ("found", "distance"):
            return getattr(contacts, f"{self.quantity}_EN")
        return getattr(contacts, f"{self.quantity}_EN3").flatten(start_dim=1)
