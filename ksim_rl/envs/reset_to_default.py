"""The reset event of an env whose config names none: back to the default pose."""

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class ResetToDefault(EventTerm):
    """Put rows that reset into the first keyframe, else the default pose at rest; on a terrain at the env's origin."""

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Write positions and velocities; whatever the rows held before this event is lost."""
        qpos_EL = view.default_qpos_L.expand(view.num_envs, -1)
        view.write_qpos(mask_E, qpos_EL if view.terrain.is_flat else view.at_origins(qpos_EL))
        view.write_qvel(mask_E, view.default_qvel_L.expand(view.num_envs, -1))
