"""Which contact belongs to which foot."""

from ksim_rl.envs.view import EnvView
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.sensors import ContactState


def foot_contact(view: EnvView, sensor: str, sites: Patterns) -> ContactState:
    """Return the state of a contact sensor that has one element for each of `sites`.

    Raises:
        ValueError: if it has another number of elements: one alone would count for every foot.
    """
    contact, num_feet = view.contact(sensor), len(view.resolver.ids("site", sites))
    if contact.found_EN.shape[-1] != num_feet:
        raise ValueError(
            f"sensor={sensor!r} has {contact.found_EN.shape[-1]} elements, and sites={sites!r} are {num_feet} feet: "
            "give the sensor one geom or body per foot, in the order of the sites"
        )
    return contact
