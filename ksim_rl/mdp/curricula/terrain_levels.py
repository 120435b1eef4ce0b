"""The curriculum of a terrain grid moves each env through its levels by how far its robot walks."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Within
from ksim_rl.envs.term import CurriculumTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import OfEntity
from ksim_rl.mdp.quantities import distance_from_origin


@dataclass(frozen=True, kw_only=True)
class TerrainLevels(OfEntity, CurriculumTerm):
    """Moves the envs whose episodes ended to other levels of `scene.terrain`, a `TerrainGrid`; reports the mean level.

    An env moves up one level when its robot got at least `up_distance` away from its origin (horizontally, at the end
    of the episode), and down one when it got less than `down_share` of the way that its last command asks for in a
    whole episode, be it that it was slow or that it fell. An env that has mastered the last level goes on at a random
    one, so that none is forgotten. The rule is that of Rudin et al., "Learning to walk in minutes", 2022.

    Attributes:
        command: the velocity command, (vx, vy, ...) in m/s.
        up_distance: share of the distance from the centre of a patch to its edge, in (0, 1].
        down_share: of the commanded way.
    """

    command: str
    up_distance: Annotated[float, Within(low=0.0, high=1.0, low_open=True)] = 0.8
    down_share: NonNegative = 0.5

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        """Move the rows of `mask_E` that have had an episode, and return the mean level of all envs, float32 []."""
        terrain = view.terrain
        level_E, top = terrain.levels_E, terrain.num_levels - 1
        distance_E = distance_from_origin(view, self.entity)
        speed_E = torch.linalg.vector_norm(view.command(self.command)[:, :2], dim=-1)
        asked_E = speed_E * (view.max_episode_length * view.step_dt)
        up_E = distance_E >= self.up_distance * terrain.half_width
        down_E = ~up_E & (distance_E < self.down_share * asked_E)
        moved_E = level_E + up_E.long() - down_E.long()
        drawn_E = (view.uniform(1)[:, 0] * terrain.num_levels).long().clamp(max=top)
        next_E = torch.where(moved_E > top, drawn_E, moved_E.clamp(min=0))
        terrain.set_levels(mask_E & (view.episode_step_E > 0), next_E)
        return terrain.levels_E.to(torch.float32).mean()
