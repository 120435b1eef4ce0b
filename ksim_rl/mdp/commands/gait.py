"""A gait command is a rhythm: it gives the phase that each foot should be in."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegativeRange
from ksim_rl.envs.term import CommandTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.scene.rendering.visualizer import DebugVisualizer


@dataclass(frozen=True, kw_only=True)
class SinusoidalGaitCommand(CommandTerm):
    """sin and cos of each foot's phase angle: all sines, then all cosines, [E, 2F].

    The angle of foot f is 2 pi (the integral of the frequency since the start of the episode + offset_f); a foot whose
    sine is positive should be in the air. The frequency is drawn per env; a new one changes the pace without a jump.

    Attributes:
        frequency: Hz.
        offsets: one per foot, in cycles: (0.0, 0.5) is a biped's walk, (0.0, 0.5, 0.5, 0.0) a trot.
    """

    frequency: NonNegativeRange
    offsets: tuple[float, ...]
    resampling_time_range_s: NonNegativeRange | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.offsets:
            raise ValueError("offsets=(): give one per foot, such as (0.0, 0.5)")

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        return {"frequency": self.frequency}

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw frequencies for the rows of `mask_E`; their phases go on from where they are."""
        held_E3 = self._held(view)
        drawn_E1 = view.uniform(1, *self.shared_ranges(view).unbind(0))
        fresh_E3 = torch.cat((drawn_E1, view.episode_time_E[:, None], self._cycles(view)[:, None]), dim=-1)
        held_E3.copy_(torch.where(mask_E[:, None], fresh_E3, held_E3))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        """Return the command of the present time, float32 [E, 2F]."""
        offsets_F = constant(self.offsets, view.device)
        angle_EF = 2.0 * math.pi * (self._cycles(view)[:, None] + offsets_F)
        return torch.cat((torch.sin(angle_EF), torch.cos(angle_EF)), dim=-1)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Write which feet should be in the air above the first robot's root: a 1 or a 0 for each."""
        x, y, z = view.root_pos_EL[env_index].tolist()
        sines = self(view)[env_index, : len(self.offsets)].tolist()
        visualizer.text((x, y, z + 0.3), "in the air: " + " ".join(str(int(sine > 0.0)) for sine in sines))

    def _cycles(self, view: EnvView) -> Tensor:
        """Cycles since the start of the episode, modulo 1, [E]."""
        frequency_E, since_E, cycles_E = self._held(view).unbind(-1)
        return torch.remainder(cycles_E + frequency_E * (view.episode_time_E - since_E), 1.0)

    def _held(self, view: EnvView) -> Tensor:
        """Frequency (Hz), time of its drawing (s), and cycles at that time, [E, 3]."""
        return view.buffer("rhythm_E3", 3)
