"""How high a root is above the ground."""

from torch import Tensor

from ksim_rl.envs.view import EnvView


def root_height(view: EnvView, entity: str = "") -> Tensor:
    """Return the height of an entity's root frame above the ground right below it, m, [E]; position stage."""
    return view.terrain.clearance(view.entity(entity).root_pos_EL[:, None])[:, 0]
