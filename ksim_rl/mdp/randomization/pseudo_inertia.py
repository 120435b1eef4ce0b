"""This event draws all ten inertial parameters of a body at once."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant
from ksim_rl.mdp.randomization.bodies import second_moments
from ksim_rl.mdp.randomization.randomize import Pair, Randomize, write_entries
from ksim_rl.physics.principal_axes import principal_axes
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.small_matrices import product

_NOTHING = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class RandomizePseudoInertia(Randomize):
    """Mass, centre of mass and inertia of bodies, drawn together, each body one that can exist.

    The body's mass distribution is deformed: J = U J0 U^T for its pseudo-inertia matrix J0 [4, 4] in the frame of
    its principal axes, with U = exp(alpha) [[exp(d1), s12, s13, t1], [0, exp(d2), s23, t2], [0, 0, exp(d3), t3],
    [0, 0, 0, 1]]. J stays positive definite for any parameters, which is what makes an inertia physical (Rucker and
    Wensing, "Smooth Parameterization of Rigid-Body Inertia", IEEE RA-L 7(2), 2022). All zero changes nothing.

    Attributes:
        bodies: names or patterns.
        alpha: half the logarithm of the mass's factor.
        stretch: d1, d2, d3: logarithms of how far the mass stretches along each principal axis.
        shear: s12, s13, s23.
        shift: t1, t2, t3: how far the centre of mass moves along each principal axis, m.
    """

    bodies: Patterns
    alpha: Pair = _NOTHING
    stretch: Pair = _NOTHING
    shear: Pair = _NOTHING
    shift: Pair = _NOTHING
    operation: Literal["add"] = "add"
    distribution: Literal["uniform", "gaussian"] = "uniform"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("alpha", "stretch", "shear", "shift"):
            self.check_range(name, getattr(self, name))

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        """All inertial parameters."""
        return ("body_mass", "body_ipos", "body_inertia", "body_iquat")

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        ids, model = view.resolver.ids("body", self.bodies), view.world.mj_model
        rows = list(ids)
        mass_N1, com_N3, axes_N4, spread_N3 = (
            array_constant(values, view.device)
            for values in (
                model.body_mass[rows][:, None],
                model.body_ipos[rows],
                model.body_iquat[rows],
                second_moments(view, ids),
            )
        )
        drawn = self.draw(
            view, len(ids), [self.alpha, *[self.stretch] * 3, *[self.shear] * 3, *[self.shift] * 3]
        )
        density_EN1, shift_EN3 = torch.exp(2.0 * drawn[..., 0:1]), drawn[..., 7:10]
        map_EN33 = _upper_triangle(torch.exp(drawn[..., 1:4]), drawn[..., 4:7])

        # Second moments about the moved centre of mass; the inertia is trace * 1 minus these.
        spread_EN33 = density_EN1[..., None] * product(map_EN33 * spread_N3[:, None, :], map_EN33.mT)
        trace_EN = spread_EN33.diagonal(dim1=-2, dim2=-1).sum(-1)
        inertia_EN33 = torch.diag_embed(trace_EN[..., None].expand(*trace_EN.shape, 3)) - spread_EN33
        moments_EN3, turn_EN4 = principal_axes(inertia_EN33)
        values = {
            "body_mass": mass_N1 * density_EN1,
            "body_ipos": com_N3 + quaternion.rotate(axes_N4[None], shift_EN3),
            "body_inertia": moments_EN3,
            "body_iquat": quaternion.multiply(axes_N4[None], turn_EN4),
        }
        for name, value_ENC in values.items():
            write_entries(view.field(name), ids, range(value_ENC.shape[-1]), mask_E, value_ENC)


def _upper_triangle(diagonal: Tensor, shear: Tensor) -> Tensor:
    """Return the matrices [..., 3, 3] of a diagonal [..., 3] and of entries 12, 13, 23 [..., 3]."""
    (first, second, third), (s12, s13, s23) = diagonal.unbind(-1), shear.unbind(-1)
    zero = torch.zeros_like(first)
    return torch.stack((first, s12, s13, zero, second, s23, zero, zero, third), dim=-1).unflatten(-1, (3, 3))
