"""This event lets episodes begin somewhere in a reference motion."""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checked import Within
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.state.motion_clock import motion_shift, motion_start_time


@dataclass(frozen=True, kw_only=True)
class ResetToMotion(EventTerm):
    """Put the whole scene into a state of a reference motion, and remember its time for `motion.motion_time`.

    On a terrain all free roots are moved with the env's origin.

    Attributes:
        file: what `view.motion` reads.
        start_range: of the motion's duration, both in [0, 1]: where episodes begin.
    """

    file: str
    start_range: Annotated[tuple[float, float], Within(low=0.0, high=1.0, ordered=True)] = (0.0, 1.0)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        motion, start_E = view.motion(self.file), motion_start_time(view, self.file)
        drawn_E = view.uniform(1, *self.start_range)[:, 0] * motion.duration_s
        start_E.copy_(torch.where(mask_E, drawn_E, start_E))
        qpos_EL, qvel_EL = motion.sample(start_E)
        shift_E3 = motion_shift(view)
        if shift_E3 is not None:
            for entity in view.entities.values():
                if entity.free_root:
                    start = entity.root_qpos.start
                    qpos_EL[:, start : start + 3] += shift_E3
        view.write_qpos(mask_E, qpos_EL)
        view.write_qvel(mask_E, qvel_EL)
