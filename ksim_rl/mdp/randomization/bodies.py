"""These events draw gravity, mass and inertia of bodies that can exist, and sizes of geoms."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import mujoco
import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant, index_constant
from ksim_rl.mdp.randomization.randomize import (
    Operation,
    Pair,
    Randomize,
    RandomizeModelField,
    write_entries,
)
from ksim_rl.physics.constants.principal_axes import principal_axes
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.small_matrices import product

_LEAST_MASS = 1e-6


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyField(RandomizeModelField):
    """Draw entries of a field of bodies (names or patterns) per world."""

    bodies: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyMass(RandomizeBodyField):
    """Mass of bodies, kg, at constant shape: the inertia about the centre of mass grows in proportion."""

    field = "body_mass"
    lowest = _LEAST_MASS

    operation: Operation = "scale"
    per_world_fields: ClassVar[tuple[str, ...]] = ("body_mass", "body_inertia")

    def _follower(self, view: EnvView) -> tuple[Tensor, Sequence[float]]:
        ids = self.ids(view)
        # Inertia per kg of the model's own body: the mass scales it, the shape stays.
        per_mass_N3 = view.world.mj_model.body_inertia[list(ids)] / _masses(view, ids)[:, None]
        return view.field("body_inertia"), per_mass_N3.ravel().tolist()


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyCom(RandomizeBodyField):
    """Centre of mass of bodies in the body's frame, m; columns x, y, z. The inertia about it does not change."""

    field = "body_ipos"
    columns = 3


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyInertia(RandomizeBodyField):
    """Inertia of bodies at constant mass: how far the mass spreads along each principal axis (columns x, y, z).

    Drawn are factors on the second moments of mass, whose sums by pairs are the principal moments, so that these
    always meet the triangle inequality. The range (f, f) for all axes scales the inertia by f. It starts from the
    body's present mass: let `RandomizeBodyMass` of the same bodies run before it, in the same mode.
    """

    field = "body_inertia"
    columns = 3
    lowest = 0.0

    per_world_fields: ClassVar[tuple[str, ...]] = ("body_mass", "body_inertia")
    operation: Literal["scale"] = "scale"

    def draw_columns(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        ids = self.ids(view)
        pairs = self.ranges_by_column()
        # Factors of 1 stand in for the model's own moments, since the draws are factors themselves.
        self._check_reach(view, np.ones((len(ids), 3)), pairs)
        # Columns without a range keep the factor 1.
        factor_EN3 = torch.ones(
            view.num_envs, 1 if self.shared else len(ids), 3, device=view.device
        )
        drawn_ENC = self.draw(view, len(ids), list(pairs.values()))
        factor_EN3[..., index_constant(tuple(pairs), view.device)] = drawn_ENC
        # From the model's own values, not the present ones: draws must not pile up over resets.
        own_N3 = array_constant(second_moments(view, ids), view.device)
        own_mass_N = array_constant(_masses(view, ids), view.device)
        # Mass may differ between worlds already; its ratio to the model's own scales all moments.
        mass_EN = view.field("body_mass")
        ratio_EN = mass_EN[:, index_constant(ids, view.device)] / own_mass_N
        spread_EN3 = own_N3 * factor_EN3 * ratio_EN[..., None]
        # Each principal moment is the sum of the spreads along the two other axes.
        inertia_EN3 = spread_EN3.sum(-1, keepdim=True) - spread_EN3
        write_entries(view.field("body_inertia"), ids, range(3), mask_E, inertia_EN3)


def second_moments(view: EnvView, ids: tuple[int, ...]) -> np.ndarray:
    """Return the integrals of the squared coordinate along each principal axis over the model's own mass, [N, 3]."""
    moments = view.world.mj_model.body_inertia[list(ids)]
    # A thin body's figure may come out below zero by rounding.
    return np.maximum(0.5 * moments.sum(-1, keepdims=True) - moments, 0.0)


def _masses(view: EnvView, ids: tuple[int, ...]) -> np.ndarray:
    """Return the model's own masses, kg, [N]; a body without mass is refused."""
    masses = view.world.mj_model.body_mass[list(ids)]
    if np.any(masses <= 0.0):
        name = view.world.mj_model.body(ids[int(masses.argmin())]).name
        raise ValueError(f"body {name!r} has no mass: leave it out")
    return masses


_NOTHING = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class RandomizePseudoInertia(Randomize):
    """Mass, centre of mass and inertia of bodies, drawn together, each body one that can exist.

    The body's mass distribution is deformed: J = U J0 U^T for its pseudo-inertia matrix J0 [4, 4] in the frame of
    its principal axes, with U = exp(alpha) [[exp(d1), s12, s13, t1], [0, exp(d2), s23, t2], [0, 0, exp(d3), t3],
    [0, 0, 0, 1]]. J stays positive definite for any parameters, which makes an inertia physical (Rucker and
    Wensing, "Smooth Parameterization of Rigid-Body Inertia", IEEE RA-L 7(2), 2022). All zero changes nothing.
    """

    drawn = ("alpha", "stretch", "shear", "shift")

    bodies: Patterns
    alpha: Pair = _NOTHING  # half the logarithm of the mass's factor
    stretch: Pair = _NOTHING  # d1, d2, d3: logarithms of the stretch along principal axes
    shear: Pair = _NOTHING  # s12, s13, s23
    shift: Pair = _NOTHING  # t1, t2, t3: m that the centre of mass moves along each principal axis
    operation: Literal["add"] = "add"
    distribution: Literal["uniform", "gaussian"] = "uniform"

    per_world_fields: ClassVar[tuple[str, ...]] = (
        "body_mass",
        "body_ipos",
        "body_inertia",
        "body_iquat",
    )

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        # Per-body constants of the model: mass [N, 1], centre of mass [N, 3], principal axes [N, 4] and
        # spread [N, 3].
        ids = view.resolver.ids("body", self.bodies)
        model = view.world.mj_model
        rows = list(ids)
        mass_N1 = array_constant(model.body_mass[rows][:, None], view.device)
        com_N3 = array_constant(model.body_ipos[rows], view.device)
        axes_N4 = array_constant(model.body_iquat[rows], view.device)
        spread_N3 = array_constant(second_moments(view, ids), view.device)
        # Ten parameters per body, in columns: alpha, 3 of stretch, 3 of shear, 3 of shift.
        ranges = [self.alpha]
        for range_of_three in (self.stretch, self.shear, self.shift):
            ranges += [range_of_three] * 3
        drawn = self.draw(view, len(ids), ranges)
        # The mass is J's lower right entry, which U scales by exp(alpha) from both sides.
        density_EN1 = torch.exp(2.0 * drawn[..., 0:1])
        shift_EN3 = drawn[..., 7:10]
        # The upper left 3 x 3 block of U / exp(alpha): stretch on the diagonal, shear above it.
        map_EN33 = torch.diag_embed(torch.exp(drawn[..., 1:4]))
        map_EN33[..., 0, 1:] = drawn[..., 4:6]
        map_EN33[..., 1, 2] = drawn[..., 6]

        # Second moments about the moved centre of mass; the inertia is trace * 1 minus these.
        spread_EN33 = density_EN1[..., None] * product(
            map_EN33 * spread_N3[:, None, :], map_EN33.mT
        )
        trace_EN = spread_EN33.diagonal(dim1=-2, dim2=-1).sum(-1)
        inertia_EN33 = (
            torch.diag_embed(trace_EN[..., None].expand(*trace_EN.shape, 3)) - spread_EN33
        )
        moments_EN3, turn_EN4 = principal_axes(inertia_EN33)
        # From the principal axes of the model's own body back into the body's frame.
        values = {
            "body_mass": mass_N1 * density_EN1,
            "body_ipos": com_N3 + quaternion.rotate(axes_N4[None], shift_EN3),
            "body_inertia": moments_EN3,
            "body_iquat": quaternion.multiply(axes_N4[None], turn_EN4),
        }
        for name, value_ENC in values.items():
            write_entries(view.field(name), ids, range(value_ENC.shape[-1]), mask_E, value_ENC)


@dataclass(frozen=True, kw_only=True)
class RandomizeGravity(RandomizeModelField):
    """Gravity of each world, m/s^2, by axis x, y, z. Projected gravity, a direction, stays the -z axis."""

    field = "gravity"
    columns = 3

    operation: Operation = "add"

    def ids(self, view: EnvView) -> tuple[int, ...]:
        # The options have one row for the whole model.
        return (0,)

    def nominal(self, view: EnvView) -> np.ndarray:
        return view.world.mj_model.opt.gravity[None]


# How many of its three sizes a geom of each kind has; sizes of other kinds cannot differ between worlds.
NUM_SIZES = {
    mujoco.mjtGeom.mjGEOM_SPHERE: 1,
    mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
    mujoco.mjtGeom.mjGEOM_CYLINDER: 2,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: 3,
    mujoco.mjtGeom.mjGEOM_BOX: 3,
}


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomSize(RandomizeModelField):
    """Sizes of primitive geoms by MuJoCo's columns, m; bounding boxes and spheres follow, mass and inertia do not."""

    field = "geom_size"
    columns = 3

    geoms: Patterns

    def _check_reach(self, view: EnvView, nominal: np.ndarray, pairs: Mapping[int, Pair]) -> None:
        model = view.world.mj_model
        for row, geom in enumerate(self.ids(view)):
            kind = mujoco.mjtGeom(int(model.geom_type[geom]))
            # Meshes and height fields have no sizes that may differ.
            count = NUM_SIZES.get(kind, 0)
            # By column, a range must not name a size that this kind of geom lacks; one pair for all skips
            # those.
            if not count or (isinstance(self.ranges, Mapping) and max(pairs) >= count):
                raise ValueError(
                    f"RandomizeGeomSize.ranges={self.ranges!r}: geom {model.geom(geom).name!r}, a "
                    f"{kind.name.removeprefix('mjGEOM_').lower()}, has {count} sizes that may differ between worlds"
                )
            for column, pair in pairs.items():
                low, _ = self.reach(nominal[row, column], pair)
                if column < count and low <= 0.0:
                    raise ValueError(
                        f"RandomizeGeomSize.ranges={self.ranges!r}: size {column} of geom {model.geom(geom).name!r} "
                        f"would reach {float(low):g} m; expected more than 0"
                    )
