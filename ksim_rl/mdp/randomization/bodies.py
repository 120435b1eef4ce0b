"""These events draw mass, centre of mass and inertia of bodies, each of them one that a real body can have."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checks import check_choice
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant, index_constant
from ksim_rl.mdp.randomization.randomize import Operation, RandomizeModelField, write_entries
from ksim_rl.scene.names import Patterns

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

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        """Mass and principal moments."""
        return ("body_mass", "body_inertia")

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

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        """Principal moments, and the mass that they go with."""
        return ("body_mass", "body_inertia")

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
