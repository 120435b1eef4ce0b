"""These metrics say what moving costs: power and cost of transport."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.envs.term import MetricTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import OfEntity, OfJoints
from ksim_rl.mdp.quantities import mechanical_power


@dataclass(frozen=True, kw_only=True)
class Power(OfJoints, MetricTerm):
    """sum_j |effort_j * velocity_j|, W, [E]: mechanical power of the actuators; braking costs as much as driving."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return mechanical_power(view, self.joints)


@dataclass(frozen=True, kw_only=True)
class CostOfTransport(OfJoints, OfEntity, MetricTerm):
    """Energy / (weight * distance) since the start of the episode, no unit; it needs gravity.

    Energy is the integral of `Power`; distance is the length of the root's path over the ground; the weight is that of
    the nominal model (m g of the root body with all that hangs on it).

    Attributes:
        min_distance: m; a path that is still shorter counts as this long, so that standing still gives a finite value.
    """

    min_distance: Positive = 0.1
    reduce: Literal["mean", "last", "max", "sum"] = "last"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        robot, model = view.entity(self.entity), view.world.mj_model
        weight = float(model.body_subtreemass[robot.root.id] * np.linalg.norm(model.opt.gravity))
        if weight == 0.0:
            raise ValueError("CostOfTransport without gravity: a weight of 0 N has no cost of transport")
        energy_E, distance_E = view.buffer("energy_E"), view.buffer("distance_E")
        energy_E.add_(mechanical_power(view, self.joints) * view.step_dt)
        distance_E.add_(torch.linalg.vector_norm(robot.root_lin_vel_w_EL[:, :2], dim=-1) * view.step_dt)
        return energy_E / (weight * distance_E.clamp(min=self.min_distance))
