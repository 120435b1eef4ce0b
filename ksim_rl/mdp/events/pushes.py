"""These events disturb a robot: by a kick, by a force that lasts, by a jump."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checked import NonNegativeRange
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp import se3_ranges
from ksim_rl.mdp.events.free_root import OfFreeRoot


@dataclass(frozen=True, kw_only=True)
class PushByVelocity(OfFreeRoot, EventTerm):
    """Kick the free root body: add a uniform draw to its velocity, whatever its mass.

    Attributes:
        velocity_range: by axis: x, y, z (m/s), roll, pitch, yaw (rad/s), world frame.
    """

    velocity_range: Mapping[str, tuple[float, float]]
    mode: Literal["startup", "reset", "interval", "step"] = "interval"

    def __post_init__(self) -> None:
        super().__post_init__()
        se3_ranges.check_ranges("velocity_range", self.velocity_range)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = self.root_of(view)
        kick_E6 = se3_ranges.draw(view, self.velocity_range)
        lin_vel_E3 = body.root_lin_vel_w_EL + kick_E6[:, :3]
        body.write_root_velocity(mask_E, lin_vel_E3, body.root_ang_vel_w_EL + kick_E6[:, 3:])


@dataclass(frozen=True, kw_only=True)
class PushByForce(EventTerm):
    """Press on a body for a while with a constant wrench at its centre of mass; both are drawn when the interval ends.

    A push that is due while another lasts replaces it. Several of these events on one body add up.

    Attributes:
        body: its name.
        wrench_range: by axis: x, y, z (N), roll, pitch, yaw (N m), world frame.
        duration_s: range, s; taken as the nearest whole number of env steps, and at least one.
    """

    body: str
    wrench_range: Mapping[str, tuple[float, float]]
    duration_s: NonNegativeRange
    mode: Literal["startup", "reset", "interval", "step"] = "interval"

    def __post_init__(self) -> None:
        super().__post_init__()
        se3_ranges.check_ranges("wrench_range", self.wrench_range)
        if self.mode != "interval":
            raise ValueError(f"mode={self.mode!r}: expected 'interval', which also says when a push ends")

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Begin a push in the rows of `mask_E`, and go on with or end those of the others; once per env step."""
        held_E6, applied_E6 = view.buffer("wrench_E6", 6), view.buffer("applied_E6", 6)
        left_E = view.buffer("left_s_E")
        drawn_E6 = se3_ranges.draw(view, self.wrench_range)
        duration_E = view.uniform(1, *self.duration_s)[:, 0].clamp(min=view.step_dt)
        left_E.copy_(torch.where(mask_E, duration_E, left_E - view.step_dt))
        held_E6.copy_(torch.where(mask_E[:, None], drawn_E6, held_E6))
        # The clock has run out at the env step that is nearest, whatever the subtractions round to.
        wrench_E6 = torch.where((left_E > 0.5 * view.step_dt)[:, None], held_E6, 0.0)
        view.world.xfrc_applied_EL[:, view.resolver.one("body", self.body)].add_(wrench_E6 - applied_E6)
        applied_E6.copy_(wrench_E6)


@dataclass(frozen=True, kw_only=True)
class Jump(OfFreeRoot, EventTerm):
    """Throw the free root body up: add the upward velocity sqrt(2 g h) that carries it a drawn height h further.

    Attributes:
        height_range: h, m, in free flight.
    """

    height_range: NonNegativeRange
    mode: Literal["startup", "reset", "interval", "step"] = "interval"

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = self.root_of(view)
        height_E = view.uniform(1, *self.height_range)[:, 0]
        up_E = torch.sqrt(2.0 * torch.linalg.vector_norm(view.world.gravity_EL, dim=-1) * height_E)
        lin_vel_E3 = body.root_lin_vel_w_EL.clone()
        lin_vel_E3[:, 2] += up_E
        body.write_root_velocity(mask_E, lin_vel_E3, body.root_ang_vel_w_EL)
