"""A joystick command is set by a person or a program, never drawn."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegativeRange
from ksim_rl.checks import check_pair
from ksim_rl.envs.term import CommandTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.rendering.visualizer import DebugVisualizer


@dataclass(frozen=True, kw_only=True)
class JoystickCommand(CommandTerm):
    """What was last set from outside, clamped to each axis' range, [E, K]; 0 at first, and kept over resets.

    Set it between two steps with `env.command_manager.set(name, values)`; the next observation shows it. So a policy
    that was trained on a drawn command of the same columns can be steered by hand.

    Attributes:
        axes: (low, high) by name, in the order of the columns, such as `{"vx": (-1.0, 1.0), "wz": (-0.5, 0.5)}`; units
            are those of the command that it stands in for.
    """

    axes: Mapping[str, tuple[float, float]]
    resampling_time_range_s: NonNegativeRange | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.axes:
            raise ValueError("axes={}: name at least one, such as {'vx': (-1.0, 1.0)}")
        for name, pair in self.axes.items():
            check_pair(f"axes.{name}", pair)
        if self.resampling_time_range_s is not None:
            raise ValueError(
                f"resampling_time_range_s={self.resampling_time_range_s!r}: it is set, never drawn; leave it out"
            )

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """The axes' limits, which a curriculum may change."""
        return self.axes

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw nothing: what was set stays."""

    def set(self, view: EnvView, value_EK: Float[Tensor, "*rows K"], mask_E: Bool[Tensor, " E"]) -> None:
        """Take values [E, K], or [K] for all alike, for the rows of `mask_E`.

        Raises:
            ValueError: if there is not one column per axis, or a value is not finite (read on the host).
        """
        held_EK = self._held(view)
        if tuple(value_EK.shape) not in (held_EK.shape[1:], held_EK.shape):
            raise ValueError(
                f"values of shape {tuple(value_EK.shape)}: expected [{len(self.axes)}], the axes {list(self.axes)}, "
                f"or {list(held_EK.shape)}"
            )
        if not bool(torch.isfinite(value_EK).all()):
            raise ValueError("values hold a number that is not finite: give finite ones")
        held_EK.copy_(torch.where(mask_E[:, None], value_EK.to(held_EK), held_EK))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        low_K, high_K = self.shared_ranges(view).unbind(0)
        return torch.clamp(self._held(view), low_K, high_K)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Write each axis' value above the first robot's root."""
        x, y, z = view.root_pos_EL[env_index].tolist()
        values = zip(self.axes, self(view)[env_index].tolist(), strict=True)
        visualizer.text((x, y, z + 0.3), ", ".join(f"{axis} {value:+.2f}" for axis, value in values))

    def _held(self, view: EnvView) -> Tensor:
        return view.buffer("held_EK", len(self.axes), keep=True)
