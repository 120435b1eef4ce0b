"""This event draws another gravity for each world."""

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checks import check_choice
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant
from ksim_rl.mdp.randomization.randomize import (
    Operation,
    Pair,
    Randomize,
    write_entries,
)


@dataclass(frozen=True, kw_only=True)
class RandomizeGravity(Randomize):
    """Gravity of each world, m/s^2. Projected gravity, a direction, stays that of the world's -z axis.

    Attributes:
        ranges: what to draw from, by axis of the world: 0 x, 1 y, 2 z.
    """

    ranges: Mapping[int, Pair]
    operation: Operation = "add"

    def __post_init__(self) -> None:
        super().__post_init__()
        for axis, pair in self.ranges.items():
            check_choice("ranges", axis, range(3))
            self.check_range(f"ranges[{axis}]", pair)

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        """Gravity, which differs between worlds without more memory."""
        return ("gravity",)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        if not self.ranges:
            return
        axes = tuple(sorted(self.ranges))
        own = view.world.mj_model.opt.gravity[list(axes)]
        drawn_E1C = self.draw(view, 1, [self.ranges[axis] for axis in axes])
        value_E1C = self.combine(array_constant(own, view.device), drawn_E1C)
        write_entries(view.field("gravity")[:, None], (0,), axes, mask_E, value_E1C)
