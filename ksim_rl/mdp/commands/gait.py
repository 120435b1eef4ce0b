"""The command that sets the rhythm of a gait."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Filled, NonNegativeRange
from ksim_rl.envs.term import CommandRanges, CommandTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.scene.rendering.visualizer import DebugVisualizer


@dataclass(frozen=True, kw_only=True)
class SinusoidalGaitCommand(CommandTerm):
    """sin and cos of each foot's phase angle: all sines, then all cosines, [E, 2F].

    The angle of foot f is 2 pi (the integral of the frequency since the start of the episode + offset_f); a foot whose
    sine is positive should be in the air. The frequency is drawn per env; a new one changes the pace without a jump.

    The frequency is in Hz, offsets in cycles, one per foot: (0.0, 0.5) is a biped's walk, (0.0, 0.5, 0.5, 0.0) a trot.
    """

    drawn = ("frequency",)

    frequency: NonNegativeRange
    offsets: Annotated[tuple[float, ...], Filled("give one per foot, such as (0.0, 0.5)")]
    resampling_time_range_s: NonNegativeRange | None = None

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        held_E3 = self._held(view)
        # A new frequency goes on from the cycles of the old one, so that the phase does not jump.
        low_1, high_1 = self.shared_ranges(view).unbind(0)
        frequency_E = view.uniform(1, low_1, high_1)[:, 0]
        fresh_E3 = torch.stack((frequency_E, view.episode_time_E, self._cycles(view)), dim=-1)
        held_E3.copy_(torch.where(mask_E[:, None], fresh_E3, held_E3))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        offsets_F = constant(self.offsets, view.device)
        angle_EF = 2.0 * math.pi * (self._cycles(view)[:, None] + offsets_F)
        return torch.cat((torch.sin(angle_EF), torch.cos(angle_EF)), dim=-1)

    def bounds(self, view: EnvView, ranges: CommandRanges) -> Sequence[tuple[float, float]]:
        return [(-1.0, 1.0)] * (2 * len(self.offsets))

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Write which feet should be in the air above the first robot's root: a 1 or a 0 for each."""
        x, y, z = view.root_pos_EL[env_index].tolist()
        sines = self(view)[env_index, : len(self.offsets)].tolist()
        marks = " ".join(str(int(sine > 0.0)) for sine in sines)
        visualizer.text((x, y, z + 0.3), f"in the air: {marks}")

    def _cycles(self, view: EnvView) -> Tensor:
        """Cycles since the start of the episode, modulo 1, [E]."""
        # Only the present frequency counts from its drawing on; earlier ones are in `cycles_E`.
        frequency_E, since_E, cycles_E = self._held(view).unbind(-1)
        return torch.remainder(cycles_E + frequency_E * (view.episode_time_E - since_E), 1.0)

    def _held(self, view: EnvView) -> Tensor:
        """Frequency (Hz), time of its drawing (s), and cycles at that time, [E, 3]."""
        return view.buffer("rhythm_E3", 3)
