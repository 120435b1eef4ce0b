"""The command that is set from outside."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Filled, NonNegativeRange, Range
from ksim_rl.envs.term import CommandRanges, CommandTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.rendering.visualizer import DebugVisualizer


@dataclass(frozen=True, kw_only=True)
class JoystickCommand(CommandTerm):
    """The values last set from outside, clamped to each axis' range, [E, K]; 0 at first, and kept over resets.

    Set it between two steps with `env.command_manager.set(name, values)`; the next observation shows it. So a policy
    that was trained on a drawn command of the same columns can be steered by hand.

    Attributes:
        axes: (low, high) by name, in the order of the columns, such as `{"vx": (-1.0, 1.0), "wz": (-0.5, 0.5)}`; units
            are as in the command that it stands in for.
    """

    axes: Annotated[Mapping[str, Range], Filled("name at least one, such as {'vx': (-1.0, 1.0)}")]
    resampling_time_range_s: NonNegativeRange | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.resampling_time_range_s is not None:
            raise ValueError(
                f"resampling_time_range_s={self.resampling_time_range_s!r}: it is set, never drawn; leave it out"
            )

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        return self.axes

    def bounds(self, view: EnvView, ranges: CommandRanges) -> Sequence[tuple[float, float]]:
        return list(ranges.values())

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw nothing: the values that were set stay."""

    def set(
        self, view: EnvView, value_EK: Float[Tensor, "*rows K"], mask_E: Bool[Tensor, " E"]
    ) -> None:
        """Take finite values [E, K], or [K] for all alike, for the rows of `mask_E`; they are checked on the host."""
        held_EK = self._held(view)
        if tuple(value_EK.shape) not in (held_EK.shape[1:], held_EK.shape):
            raise ValueError(
                f"values of shape {tuple(value_EK.shape)}: expected [{len(self.axes)}], the axes {list(self.axes)}, "
                f"or {list(held_EK.shape)}"
            )
        # A NaN would reach the policy's observation; reading it here waits for the device, which is fine
        # between steps.
        if not bool(torch.isfinite(value_EK).all()):
            raise ValueError("values hold a number that is not finite: give finite ones")
        held_EK.copy_(torch.where(mask_E[:, None], value_EK.to(held_EK), held_EK))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        # Clamped when read, since a curriculum may have narrowed the ranges since `set`.
        low_K, high_K = self.shared_ranges(view).unbind(0)
        return torch.clamp(self._held(view), low_K, high_K)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        x, y, z = view.root_pos_EL[env_index].tolist()
        values = zip(self.axes, self(view)[env_index].tolist(), strict=True)
        shown = ", ".join(f"{axis} {value:+.2f}" for axis, value in values)
        visualizer.text((x, y, z + 0.3), shown)

    def _held(self, view: EnvView) -> Tensor:
        # Kept over resets: the driver does not know of them.
        return view.buffer("held_EK", len(self.axes), keep=True)
