"""Terms take the fields of these classes, so that each is explained and checked once."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.envs.term import ObservationTerm, RewardTerm, Term
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.quantities import is_commanded
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.sensors import ContactState
from ksim_rl.scene.state.entity import Entity


@dataclass(frozen=True, kw_only=True)
class OfEntity(Term):
    """A term of one robot or object.

    Attributes:
        entity: its name in `scene.robots` or `scene.objects`; "" is the first robot.
    """

    entity: str = ""


@dataclass(frozen=True, kw_only=True)
class InFrame(OfEntity):
    """A term of something that is given in a frame.

    Attributes:
        frame: "root" is the frame of the root body of `entity`; "world".
    """

    frame: Literal["root", "world"] = "root"


@dataclass(frozen=True, kw_only=True)
class OfJoints(Term):
    """A term of some joints.

    Attributes:
        joints: names or regular expressions of hinges and slides; ".*" is all, in the model's order.
    """

    joints: Patterns = ".*"


@dataclass(frozen=True, kw_only=True)
class OfContacts(Term):
    """A term of contacts that are stronger than a threshold.

    Attributes:
        sensor: a contact sensor of `scene.sensors`.
        threshold: N, which the net force must exceed, sampled at the last physics substep of the env step.
    """

    sensor: str
    threshold: NonNegative


@dataclass(frozen=True, kw_only=True)
class OfFeet(Term):
    """A term of how feet move and what they touch.

    Attributes:
        sensor: a contact sensor of `scene.sensors` with one geom or body per foot, in the order of `sites`.
        sites: names or patterns of the feet.
    """

    sensor: str
    sites: Patterns

    def contact(self, view: EnvView) -> ContactState:
        """Return the state of the contact sensor.

        Raises:
            ValueError: if it has another number of elements than feet: one alone would count for every foot.
        """
        contact, num_feet = view.contact(self.sensor), len(view.sites(self.sites))
        if contact.found_EN.shape[-1] != num_feet:
            raise ValueError(
                f"sensor={self.sensor!r} has {contact.found_EN.shape[-1]} elements, and sites={self.sites!r} are "
                f"{num_feet} feet: give the sensor one geom or body per foot, in the order of the sites"
            )
        return contact


@dataclass(frozen=True, kw_only=True)
class GaussianReward(RewardTerm):
    """exp(-error^2 / std^2): 1 without an error.

    Attributes:
        std: in the unit of the error.
    """

    std: Positive

    def rate(self, squared_error_E: Float[Tensor, " E"]) -> Float[Tensor, " E"]:
        """Return the reward of a squared error."""
        return torch.exp(squared_error_E / -(self.std**2))


@dataclass(frozen=True, kw_only=True)
class OfFreeRoot(OfEntity):
    """A term that moves the root of a robot or object."""

    def root_of(self, view: EnvView) -> Entity:
        """Return the entity.

        Raises:
            ValueError: if there is none of this name, or its root is fixed.
        """
        entity = view.entity(self.entity)
        if not entity.free_root:
            raise ValueError(
                f"{type(self).__name__} needs a robot whose first joint is free; the root of {entity.name!r} is fixed"
            )
        return entity


@dataclass(frozen=True, kw_only=True)
class FramedObservation(InFrame, ObservationTerm):
    """An observation in a frame: positions are relative to its origin, velocities and forces given in its axes.

    In the root's frame they remain velocities over the ground, as `RootLinVel` is.
    """

    def points(self, view: EnvView, pos_EN3: Float[Tensor, "E N 3"]) -> Float[Tensor, "E L"]:
        """Return points of the world in the term's frame, m, flat, [E, 3N]."""
        if self.frame == "root":
            pos_EN3 = pos_EN3 - view.entity(self.entity).root_pos_EL[:, None]
        return self.vectors(view, pos_EN3)

    def vectors(self, view: EnvView, vector_EN3: Float[Tensor, "E N 3"]) -> Float[Tensor, "E L"]:
        """Return vectors of the world in the term's axes, flat, [E, 3N]."""
        if self.frame == "root":
            vector_EN3 = quaternion.rotate_inverse(view.entity(self.entity).root_quat_EL[:, None], vector_EN3)
        return vector_EN3.flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class RewardWhileCommanded(RewardTerm):
    """A reward that counts only while a velocity command asks to move.

    Attributes:
        command, command_threshold: the term is 0 unless the commanded speed exceeds the threshold.
    """

    command: str
    command_threshold: NonNegative

    def while_commanded(self, view: EnvView, value_E: Float[Tensor, " E"]) -> Float[Tensor, " E"]:
        """Return the value where the command asks to move, else 0."""
        return value_E * is_commanded(view, self.command, self.command_threshold)
