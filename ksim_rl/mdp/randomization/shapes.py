"""These events give things another size in each world, with the mass and inertia that fit it, and set them down.

Kinds of geoms and meshes are the same in all worlds: a world cannot have a ball where another one has a box.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant, constant
from ksim_rl.mdp.fields import OfEntity
from ksim_rl.mdp.randomization.bodies import (
    NUM_SIZES,
    RandomizeBodyField,
    RandomizeBodyMass,
    RandomizeGeomSize,
    RandomizePseudoInertia,
)
from ksim_rl.mdp.randomization.randomize import write_entries
from ksim_rl.scene import quaternion

_GEOM = mujoco.mjtGeom


def volume(kind: _GEOM, size_E3: Float[Tensor, "E 3"]) -> Float[Tensor, " E"]:
    """Return the volume of a primitive geom of MuJoCo's sizes, m^3."""
    a_E, b_E, c_E = size_E3.unbind(-1)
    ball_E = 4.0 / 3.0 * math.pi * a_E**3
    tube_E = 2.0 * math.pi * a_E**2 * b_E
    if kind == _GEOM.mjGEOM_SPHERE:
        return ball_E
    if kind == _GEOM.mjGEOM_CYLINDER:
        return tube_E
    if kind == _GEOM.mjGEOM_CAPSULE:
        return tube_E + ball_E
    if kind == _GEOM.mjGEOM_ELLIPSOID:
        return 4.0 / 3.0 * math.pi * a_E * b_E * c_E
    return 8.0 * a_E * b_E * c_E


def inertia_per_mass(kind: _GEOM, size_E3: Float[Tensor, "E 3"]) -> Float[Tensor, "E 3"]:
    """Return the moments of inertia about a solid geom's own axes for 1 kg, m^2."""
    a_E, b_E, c_E = size_E3.square().unbind(-1)
    if kind == _GEOM.mjGEOM_SPHERE:
        return 0.4 * torch.stack((a_E, a_E, a_E), dim=-1)
    if kind in (_GEOM.mjGEOM_BOX, _GEOM.mjGEOM_ELLIPSOID):
        share = 1.0 / 3.0 if kind == _GEOM.mjGEOM_BOX else 1.0 / 5.0
        return share * torch.stack((b_E + c_E, a_E + c_E, a_E + b_E), dim=-1)
    # Radius and half length, squared, are in `a` and `b`: a cylinder's moments first.
    across_E = a_E / 4.0 + b_E / 3.0
    along_E = a_E / 2.0
    if kind == _GEOM.mjGEOM_CAPSULE:
        # The share of the mass that is in the two half balls, whose centres lie 3/8 of a radius outside of the ends.
        radius_E, half_E, _ = size_E3.unbind(-1)
        balls_E = 2.0 * radius_E / (2.0 * radius_E + 3.0 * half_E)
        ball_across_E = 0.4 * a_E + half_E * (0.75 * radius_E + half_E)
        across_E = torch.lerp(across_E, ball_across_E, balls_E)
        along_E = torch.lerp(along_E, 0.4 * a_E, balls_E)
    return torch.stack((across_E, across_E, along_E), dim=-1)


def geom_size(view: EnvView, geom: int) -> Float[Tensor, "E 3"]:
    """Return the present size of a geom in each world by MuJoCo's columns, m."""
    if "geom_size" in view.world.per_world_fields():
        return view.field("geom_size")[:, geom]
    own_3 = array_constant(view.world.mj_model.geom_size[geom], view.device)
    return own_3.expand(view.num_envs, 3)


def reach_down(
    kind: _GEOM, size_E3: Float[Tensor, "E 3"], quat_E4: Float[Tensor, "E 4"]
) -> Float[Tensor, " E"]:
    """Return how far a primitive geom reaches below its centre in an orientation, m."""
    # The vertical in the geom's frame.
    vertical_3 = constant((0.0, 0.0, 1.0), size_E3.device)
    up_E3 = quaternion.rotate_inverse(quat_E4, vertical_3.expand_as(size_E3))
    if kind == _GEOM.mjGEOM_BOX:
        return (up_E3.abs() * size_E3).sum(-1)
    if kind == _GEOM.mjGEOM_ELLIPSOID:
        return torch.linalg.vector_norm(up_E3 * size_E3, dim=-1)
    radius_E, half_E, _ = size_E3.unbind(-1)
    if kind == _GEOM.mjGEOM_SPHERE:
        return radius_E
    upright_E = up_E3[:, 2].abs()
    if kind == _GEOM.mjGEOM_CAPSULE:
        return radius_E + half_E * upright_E
    lying_E = (1.0 - upright_E.square()).clamp(min=0.0).sqrt()
    return radius_E * lying_E + half_E * upright_E


@dataclass(frozen=True, kw_only=True)
class RandomizeSolidSize(RandomizeGeomSize):
    """Sizes of things that are one solid geom each, by MuJoCo's columns, m, with the mass and inertia that fit them.

    Each world is as if its model were compiled with its sizes.

    Attributes:
        constant: what stays: the "mass", which `RandomizeBodyMass` may draw before, in the same mode; or the "density"
            of the model.
    """

    constant: Literal["mass", "density"] = "mass"

    per_world_fields: ClassVar[tuple[str, ...]] = ("geom_size", "body_mass", "body_inertia")

    def draw_columns(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        super().draw_columns(view, mask_E)
        model = view.world.mj_model
        for geom in self.ids(view):
            kind = _GEOM(int(model.geom_type[geom]))
            body = int(model.geom_bodyid[geom])
            own_13 = torch.tensor(model.geom_size[geom : geom + 1], dtype=torch.float32)
            mass = float(model.body_mass[body])
            fits = mass * inertia_per_mass(kind, own_13)[0].numpy()
            # Such as a body of several geoms, a hollow one, or one with an <inertial> element.
            if mass <= 0.0 or not np.allclose(fits, model.body_inertia[body], rtol=1e-3):
                raise ValueError(
                    f"RandomizeSolidSize.geoms={self.geoms!r}: body {model.body(body).name!r} has another mass or "
                    f"inertia than geom {model.geom(geom).name!r} alone would give: use RandomizeGeomSize, which keeps "
                    "both"
                )
            size_E3 = view.field("geom_size")[:, geom]
            if self.constant == "density":
                mass_E = mass * volume(kind, size_E3) / float(volume(kind, own_13))
            else:
                # Worlds may differ in it already.
                mass_E = view.field("body_mass")[:, body]
            inertia_E3 = mass_E[:, None] * inertia_per_mass(kind, size_E3)
            mass_E11 = mass_E[:, None, None]
            write_entries(view.field("body_mass"), (body,), (0,), mask_E, mass_E11)
            write_entries(
                view.field("body_inertia"), (body,), range(3), mask_E, inertia_E3[:, None]
            )

    def check_beside(self, view: EnvView, events: Mapping[str, EventTerm]) -> None:
        model = view.world.mj_model
        own = set(model.geom_bodyid[list(self.ids(view))].tolist())
        is_behind = False
        for name, event in events.items():
            is_behind = is_behind or event is self
            if not isinstance(event, RandomizeBodyField | RandomizePseudoInertia):
                continue
            shared = own.intersection(view.resolver.ids("body", event.bodies))
            if "body_inertia" not in event.per_world_fields or not shared:
                continue
            draws_mass = isinstance(event, RandomizeBodyMass) and self.constant == "mass"
            if draws_mass and event.mode == self.mode and not is_behind:
                continue
            raise ValueError(
                f"events.{name} draws mass or inertia of body {model.body(min(shared)).name!r}, as "
                f"RandomizeSolidSize.geoms={self.geoms!r} does, and one would undo the other: leave it out, or let "
                "RandomizeBodyMass alone run before it, in the same mode and with constant='mass'"
            )


@dataclass(frozen=True, kw_only=True)
class SetDown(OfEntity, EventTerm):
    """Put a free body that is one geom onto a height (m, above the env's origin), whatever its size and orientation.

    It moves its root alone, up or down: let it run behind what draws sizes and places.
    """

    height: float = 0.0

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        entity = view.entity(self.entity)
        geom = _only_geom(view, self.entity)
        model = view.world.mj_model
        kind = _GEOM(int(model.geom_type[geom]))
        quat_E4 = entity.root_quat_EL
        rest_E = self.height + reach_down(kind, geom_size(view, geom), quat_E4)
        if not view.terrain.is_flat:
            rest_E = rest_E + view.terrain.origins_E3[:, 2]
        pos_E3 = torch.cat((entity.root_pos_EL[:, :2], rest_E[:, None]), dim=-1)
        entity.write_root_pose(mask_E, pos_E3, quat_E4)


def _only_geom(view: EnvView, name: str) -> int:
    """Return the geom of an entity's root; a ValueError if it is not a primitive one, in the middle of the body."""
    model = view.world.mj_model
    (body,) = view.entity(name).root_bodies.ids
    # Those of bodies that hang from it, too: they would reach below.
    geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body_rootid[body])
    lone = len(geoms) == 1 and int(model.geom_type[geoms[0]]) in set(NUM_SIZES)
    if not lone or model.geom_pos[geoms[0]].any() or model.geom_quat[geoms[0], 1:].any():
        raise ValueError(
            f"SetDown.entity={name!r}: body {model.body(body).name!r} is not one primitive geom about its origin, "
            "alone: place it with ResetRootUniform"
        )
    return int(geoms[0])
