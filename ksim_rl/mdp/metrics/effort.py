"""What moving costs: power and cost of transport.

Efforts are those of the last physics substep (acceleration stage), velocities those of the current state.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import MetricTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class Power(MetricTerm):
    """sum_j |effort_j * velocity_j|, W, [E]: mechanical power of the actuators; braking costs as much as driving.

    Attributes:
        joints: names or patterns.
    """

    joints: Patterns = ".*"

    def __call__(self, view: EnvView) -> Tensor:
        """Return the value of the current state, [E]."""
        return mechanical_power(view, self.joints)


@dataclass(frozen=True, kw_only=True)
class CostOfTransport(MetricTerm):
    """Energy / (weight * distance) since the start of the episode, no unit, [E].

    Energy is the integral of `Power`; distance is the length of the root's path over the ground; the weight is that of
    the nominal model (m g of the root body with all that hangs on it).

    Attributes:
        min_distance: m; a path that is still shorter counts as this long, so that standing still gives a finite value.
        joints: names or patterns.
        entity: the robot; "" is the first one.
    """

    min_distance: float = 0.1
    joints: Patterns = ".*"
    entity: str = ""
    reduce: Literal["mean", "last", "max", "sum"] = "last"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("min_distance", self.min_distance, low=0.0, low_open=True)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the value up to the current state, [E].

        Raises:
            ValueError: if nothing weighs anything.
        """
        robot, model = view.entity(self.entity), view.world.mj_model
        weight = float(model.body_subtreemass[robot.root.id] * np.linalg.norm(model.opt.gravity))
        if weight == 0.0:
            raise ValueError("CostOfTransport without gravity: a weight of 0 N has no cost of transport")
        energy_E, distance_E = view.buffer("energy_E"), view.buffer("distance_E")
        energy_E.add_(mechanical_power(view, self.joints) * view.step_dt)
        distance_E.add_(torch.linalg.vector_norm(robot.root_lin_vel_w_EL[:, :2], dim=-1) * view.step_dt)
        return energy_E / (weight * distance_E.clamp(min=self.min_distance))


def mechanical_power(view: EnvView, joints: Patterns) -> Tensor:
    """Return sum_j |effort_j * velocity_j| over joints, W, [E]."""
    driven = view.joints(joints)
    return (driven.effort_EL * driven.vel_EL).abs().sum(-1)
