"""Events that move a whole robot write its free root; this is their base."""

from dataclasses import dataclass

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import OfEntity
from ksim_rl.scene.state.entity import Entity


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
