"""These events draw gravity, and mass, centre of mass and inertia of bodies, all of them ones that can exist."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checks import check_choice
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant, index_constant
from ksim_rl.mdp.randomization.randomize import Operation, Pair, Randomize, RandomizeModelField, write_entries
from ksim_rl.physics.principal_axes import principal_axes
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.small_matrices import product

_LEAST_MASS = 1e-6


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyField(RandomizeModelField):
    """Draw entries of a field of bodies per world.

    Attributes:
        bodies: names or patterns.
    """

    bodies: Patterns

    kind: ClassVar[str] = "body"

    @property
    def elements(self) -> Patterns:
        return self.bodies


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyMass(RandomizeBodyField):
    """Mass of bodies, kg, at constant shape: the inertia about the centre of mass grows in proportion.

    Let `RandomizeBodyInertia` of the same bodies run after it, in the same mode.
    """

    field: ClassVar[str] = "body_mass"
    lowest: ClassVar[float | None] = _LEAST_MASS
    operation: Operation = "scale"

    per_world_fields: ClassVar[tuple[str, ...]] = ("body_mass", "body_inertia")

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        super().__call__(view, mask_E)
        ids = self.ids(view)
        own_N3 = array_constant(view.world.mj_model.body_inertia[list(ids)], view.device)
        inertia_EN3 = own_N3 * _mass_ratio(view, ids)[..., None]
        write_entries(view.field("body_inertia"), ids, range(3), mask_E, inertia_EN3)


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyCom(RandomizeBodyField):
    """Centre of mass of bodies in the body's frame, m; columns x, y, z. The inertia about it does not change."""

    field: ClassVar[str] = "body_ipos"
    columns: ClassVar[int] = 3


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyInertia(RandomizeBodyField):
    """Inertia of bodies at constant mass: how far the mass spreads along each principal axis (columns x, y, z).

    Drawn are factors on the second moments of mass, whose sums by pairs are the principal moments, so that these
    always meet the triangle inequality. The range (f, f) for all axes scales the inertia by f. It starts from the
    body's present mass: let `RandomizeBodyMass` of the same bodies run before it, in the same mode.
    """

    field: ClassVar[str] = "body_inertia"
    columns: ClassVar[int] = 3
    lowest: ClassVar[float | None] = 0.0
    operation: Operation = "scale"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("operation", self.operation, ("scale",))

    per_world_fields: ClassVar[tuple[str, ...]] = ("body_mass", "body_inertia")

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        ids, pairs = self.ids(view), self.pairs()
        self._check_reach(view, np.ones((len(ids), 3)), pairs)
        factor_EN3 = torch.ones(view.num_envs, 1 if self.shared else len(ids), 3, device=view.device)
        factor_EN3[..., index_constant(tuple(pairs), view.device)] = self.draw(
            view, len(ids), list(pairs.values())
        )
        own_N3 = array_constant(second_moments(view, ids), view.device)
        spread_EN3 = own_N3 * factor_EN3 * _mass_ratio(view, ids)[..., None]
        inertia_EN3 = spread_EN3.sum(-1, keepdim=True) - spread_EN3
        write_entries(view.field("body_inertia"), ids, range(3), mask_E, inertia_EN3)


def second_moments(view: EnvView, ids: tuple[int, ...]) -> np.ndarray:
    """Return the integrals of the squared coordinate along each principal axis over the model's own mass, [N, 3]."""
    moments = view.world.mj_model.body_inertia[list(ids)]
    # A thin body's figure may come out below zero by rounding.
    return np.maximum(0.5 * moments.sum(-1, keepdims=True) - moments, 0.0)


def _mass_ratio(view: EnvView, ids: tuple[int, ...]) -> Tensor:
    """Return the present masses over the model's own, [E, N].

    Raises:
        ValueError: naming a body without mass.
    """
    masses = view.world.mj_model.body_mass[list(ids)]
    if np.any(masses <= 0.0):
        name = view.world.mj_model.body(ids[int(masses.argmin())]).name
        raise ValueError(f"body {name!r} has no mass: leave it out")
    return view.field("body_mass")[:, index_constant(ids, view.device)] / array_constant(masses, view.device)


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

    per_world_fields: ClassVar[tuple[str, ...]] = ("body_mass", "body_ipos", "body_inertia", "body_iquat")

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

    per_world_fields: ClassVar[tuple[str, ...]] = ("gravity",)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        if not self.ranges:
            return
        axes = tuple(sorted(self.ranges))
        own = view.world.mj_model.opt.gravity[list(axes)]
        drawn_E1C = self.draw(view, 1, [self.ranges[axis] for axis in axes])
        value_E1C = self.combine(array_constant(own, view.device), drawn_E1C)
        write_entries(view.field("gravity")[:, None], (0,), axes, mask_E, value_E1C)
