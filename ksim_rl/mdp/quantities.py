"""Several terms read these quantities, which are derived from those of the view."""

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.scene.names import Patterns


def root_height(view: EnvView, entity: str = "") -> Float[Tensor, " E"]:
    """Return the height of an entity's root frame above the ground right below it, m; position stage."""
    return view.terrain.clearance(view.entity(entity).root_pos_EL[:, None])[:, 0]


def distance_from_origin(view: EnvView, entity: str) -> Float[Tensor, " E"]:
    """Return the horizontal distance of an entity's root from where its env starts, m; position stage."""
    away_E3 = view.entity(entity).root_pos_EL - view.terrain.origins_E3
    return torch.linalg.vector_norm(away_E3[:, :2], dim=-1)


def mechanical_power(view: EnvView, joints: Patterns) -> Float[Tensor, " E"]:
    """Return the sum over joints of |effort * velocity|, W: braking costs as much as driving.

    Efforts belong to the last physics substep (acceleration stage), velocities to the state that it reached.
    """
    driven = view.joints(joints)
    return (driven.effort_EL * driven.vel_EL).abs().sum(-1)


def contact_force(view: EnvView, sensor: str) -> Float[Tensor, "E N"]:
    """Return the magnitude of the net force on each element of a contact sensor, N; acceleration stage."""
    return torch.linalg.vector_norm(view.contact(sensor).force_EN3, dim=-1)


def commanded_speed(view: EnvView, command: str) -> Float[Tensor, " E"]:
    """Return |c_xy| + |c_z| of the command (vx, vy, wz), m/s and rad/s added as numbers."""
    key = f"speed of {command}"
    speed_E = view.command_cache.get(key)
    if speed_E is None:
        command_EK = view.command(command)
        speed_E = torch.linalg.vector_norm(command_EK[:, :2], dim=-1) + command_EK[:, 2].abs()
        view.command_cache[key] = speed_E
    return speed_E


def is_commanded(view: EnvView, command: str, threshold: float) -> Float[Tensor, " E"]:
    """Return 1 where the commanded speed exceeds the threshold, else 0."""
    key = f"speed of {command} > {threshold}"
    moves_E = view.command_cache.get(key)
    if moves_E is None:
        moves_E = (commanded_speed(view, command) > threshold).to(torch.float32)
        view.command_cache[key] = moves_E
    return moves_E
