"""Terms take the fields of these classes, so that each is explained and checked once."""

from dataclasses import dataclass
from typing import Literal

from ksim_rl.checked import NonNegative
from ksim_rl.envs.term import Term
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.sensors import ContactState


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
