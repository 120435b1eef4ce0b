"""Terms take the fields of these classes and the quantities of these functions, so that each is said once."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.envs.term import ObservationTerm, RewardTerm, Term
from ksim_rl.envs.view import EnvView
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.sensors import ContactState


@dataclass(frozen=True, kw_only=True)
class OfEntity(Term):
    """A term of one robot or object, by its name in `scene.robots` or `scene.objects`; "" is the first robot."""

    entity: str = ""


@dataclass(frozen=True, kw_only=True)
class InFrame(OfEntity):
    """A term of something that is given in the frame of the root body of `entity`, or of the world."""

    frame: Literal["root", "world"] = "root"


@dataclass(frozen=True, kw_only=True)
class OfJoints(Term):
    """A term of hinges and slides, by names or regular expressions; ".*" is all, in the model's order."""

    joints: Patterns = ".*"


@dataclass(frozen=True, kw_only=True)
class OfCommand(Term):
    """A term of a command, by its name in `commands`."""

    command: str


@dataclass(frozen=True, kw_only=True)
class OfSensor(Term):
    """A term of a sensor of `scene.sensors`, or of one of the model's, by its name."""

    sensor: str


@dataclass(frozen=True, kw_only=True)
class OfSites(Term):
    """A term of sites, by names or regular expressions."""

    sites: Patterns


@dataclass(frozen=True, kw_only=True)
class SiteAndBody(Term):
    """A term of where a site is and where a body's origin."""

    site: str
    body: str

    def offset(self, view: EnvView) -> Float[Tensor, "E 3"]:
        """Return the body's origin minus the site, world frame, m; position stage."""
        return view.body(self.body).pos_EL - view.site(self.site).pos_EL


@dataclass(frozen=True, kw_only=True)
class OfContacts(OfSensor):
    """A term of where the net force on a contact sensor exceeds a threshold, N, at the last substep."""

    threshold: NonNegative


@dataclass(frozen=True, kw_only=True)
class OfFeet(OfSites, OfSensor):
    """A term of how feet (sites) move, and of a contact sensor with one geom or body per foot in the same order."""

    def contact(self, view: EnvView) -> ContactState:
        """Return the state of the contact sensor; one element alone would count for all feet, and is refused."""
        contact = view.contact(self.sensor)
        num_feet = len(view.sites(self.sites))
        # One element for all feet would broadcast without an error.
        if contact.found_EN.shape[-1] != num_feet:
            raise ValueError(
                f"sensor={self.sensor!r} has {contact.found_EN.shape[-1]} elements, and sites={self.sites!r} are "
                f"{num_feet} feet: give the sensor one geom or body per foot, in the order of the sites"
            )
        return contact


@dataclass(frozen=True, kw_only=True)
class GaussianReward(RewardTerm):
    """exp(-error^2 / std^2): 1 without an error; `std` is in the unit of the error."""

    std: Positive

    def rate(self, squared_error_E: Float[Tensor, " E"]) -> Float[Tensor, " E"]:
        """Return the reward of a squared error."""
        return torch.exp(squared_error_E / -(self.std**2))


@dataclass(frozen=True, kw_only=True)
class FramedObservation(InFrame, ObservationTerm):
    """An observation in a frame: positions are relative to its origin, velocities and forces given in its axes.

    In the root's frame they remain velocities over the ground, as `RootLinVel` is.
    """

    def points(self, view: EnvView, pos_EN3: Float[Tensor, "E N 3"]) -> Float[Tensor, "E L"]:
        """Return points of the world in the term's frame, m, flat, [E, 3N]."""
        if self.frame == "root":
            # Positions are relative to the origin of the frame; directions are not.
            # The root's origin [E, 1, 3] broadcasts over the points.
            pos_EN3 = pos_EN3 - view.entity(self.entity).root_pos_EL[:, None]
        return self.vectors(view, pos_EN3)

    def rotations6d(
        self, view: EnvView, axes_EN33: Float[Tensor, "E N 3 3"]
    ) -> Float[Tensor, "E L"]:
        """Return the x axis, then the y axis, of frames whose axes are the rows, in the term's axes, flat, [E, 6N]."""
        # [E, N, 2, 3] as [E, 2N, 3]: each axis is a vector to rotate.
        return self.vectors(view, axes_EN33[:, :, :2].flatten(start_dim=1, end_dim=2))

    def vectors(self, view: EnvView, vector_EN3: Float[Tensor, "E N 3"]) -> Float[Tensor, "E L"]:
        """Return vectors of the world in the term's axes, flat, [E, 3N]."""
        if self.frame == "root":
            # Rotations from world to root; [E, 1, 4] broadcasts over N.
            vector_EN3 = quaternion.rotate_inverse(
                view.entity(self.entity).root_quat_EL[:, None], vector_EN3
            )
        # Observations are flat per env: x, y, z of the first point, then of the second.
        return vector_EN3.flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class RewardWhileCommanded(OfCommand, RewardTerm):
    """A reward that is 0 unless the speed that a velocity command asks for exceeds a threshold."""

    command_threshold: NonNegative

    def while_commanded(self, view: EnvView, value_E: Float[Tensor, " E"]) -> Float[Tensor, " E"]:
        """Return the value where the command asks to move, else 0."""
        # A factor of 0 or 1 instead of a branch, which a captured step could not take.
        return value_E * is_commanded(view, self.command, self.command_threshold)


def root_height(view: EnvView, entity: str = "") -> Float[Tensor, " E"]:
    """Return the height of an entity's root frame above the ground right below it, m; position stage."""
    return view.entity(entity).root_height_E


def distance_from_origin(view: EnvView, entity: str) -> Float[Tensor, " E"]:
    """Return the horizontal distance of an entity's root from where its env starts, m; position stage."""
    # Height does not count: a robot that falls has not walked.
    away_E3 = view.entity(entity).root_pos_EL - view.terrain.origins_E3
    return torch.linalg.vector_norm(away_E3[:, :2], dim=-1)


def mechanical_power(view: EnvView, joints: Patterns) -> Float[Tensor, " E"]:
    """Return the sum over joints of |effort (acceleration stage) * velocity|, W: braking costs as much as driving."""
    # Without the absolute value, braking would pay back the cost of driving.
    driven = view.joints(joints)
    return (driven.effort_EL * driven.vel_EL).abs().sum(-1)


def contact_force(view: EnvView, sensor: str) -> Float[Tensor, "E N"]:
    """Return the magnitude of the net force on each element of a contact sensor, N; acceleration stage."""
    return torch.linalg.vector_norm(view.contact(sensor).force_EN3, dim=-1)


def commanded_speed(view: EnvView, command: str) -> Float[Tensor, " E"]:
    """Return |c_xy| + |c_z| of the command (vx, vy, wz), m/s and rad/s added as numbers."""
    # Several terms ask for the same speed in each step; the cache is emptied when commands change.
    cache = view.command_cache
    key = f"speed of {command}"
    if key not in cache:
        command_EK = view.command(command)
        planar_E = torch.linalg.vector_norm(command_EK[:, :2], dim=-1)
        cache[key] = planar_E + command_EK[:, 2].abs()
    return cache[key]


def is_commanded(view: EnvView, command: str, threshold: float) -> Float[Tensor, " E"]:
    """Return 1 where the commanded speed exceeds the threshold, else 0."""
    cache = view.command_cache
    key = f"speed of {command} > {threshold}"
    if key not in cache:
        cache[key] = (commanded_speed(view, command) > threshold).to(torch.float32)
    return cache[key]
