"""These commands are the targets that the DeepMind Control Suite draws in each episode, world frame, m."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegativeRange, Positive, Share
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.pose import HeldCommand
from ksim_rl.mdp.constants import constant
from ksim_rl.scene.rendering.visualizer import DebugVisualizer

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Target(HeldCommand):
    """A point, [E, 3], drawn when an episode begins; `size` is the radius of the ball that is drawn for it."""

    size: Positive
    resampling_time_range_s: NonNegativeRange | None = None

    def held(self, view: EnvView) -> Float[Tensor, "E 3"]:
        return view.buffer("target_E3", 3)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        x, y, z = self.held(view)[env_index].tolist()
        visualizer.sphere((x, y, z), radius=self.size, rgba=(0.2, 0.6, 0.2, 0.8))


@dataclass(frozen=True, kw_only=True)
class BoxTarget(Target):
    """A point uniform in a box; a share of them lies in a box that is `near_scale` times as large, about the origin."""

    low: Point
    high: Point
    near_share: Share = 0.0
    near_scale: Point = (1.0, 1.0, 1.0)

    def draw(self, view: EnvView) -> Float[Tensor, "E 3"]:
        # Uniform by volume.
        point_E3 = view.uniform(
            3, constant(self.low, view.device), constant(self.high, view.device)
        )
        # One draw less where no target is near.
        if not self.near_share:
            return point_E3
        is_near_E1 = view.uniform(1) < self.near_share
        # The near box is about the origin, so that scaling the point is enough.
        return torch.where(is_near_E1, point_E3 * constant(self.near_scale, view.device), point_E3)


@dataclass(frozen=True, kw_only=True)
class RingTarget(Target):
    """A point at a uniform angle and a uniform distance from a centre, in a plane of the world."""

    center: Point
    radius: NonNegativeRange
    plane: Literal["xy", "xz"] = "xy"

    def draw(self, view: EnvView) -> Float[Tensor, "E 3"]:
        share_E, angle_E = view.uniform(2).unbind(-1)
        inner, outer = self.radius
        # Uniform in distance, as dm_control has it, and not by area.
        radius_E = inner + share_E * (outer - inner)
        angle_E = 2.0 * torch.pi * angle_E
        # The angle counts from the second axis of the plane.
        first_E = radius_E * torch.sin(angle_E)
        second_E = radius_E * torch.cos(angle_E)
        zero_E = torch.zeros_like(first_E)
        if self.plane == "xy":
            offset = (first_E, second_E, zero_E)
        else:
            offset = (first_E, zero_E, second_E)
        return constant(self.center, view.device) + torch.stack(offset, dim=-1)
