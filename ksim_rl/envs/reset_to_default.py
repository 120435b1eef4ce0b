"""The event of an env that configures none."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class ResetToDefault(EventTerm):
    """Put rows that reset into the model's first keyframe or, without one, its default pose, at rest."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        """Write positions; the masked reset has already zeroed the velocities."""
        view.write_qpos(mask_E, view.default_qpos_L.expand(view.num_envs, -1))
        view.write_qvel(mask_E, torch.zeros_like(view.world.qvel_EL))
