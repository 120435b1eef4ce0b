"""What every terrain has: a config that edits the model, and the ground that terms read."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco

from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.terrains.look import MATERIAL

if TYPE_CHECKING:
    from ksim_rl.envs.view import EnvView

BODY = "terrain"
"""Name of the body, and of the geom, that a terrain adds to the world."""


def add_ground(spec: mujoco.MjSpec, *, friction: Sequence[float], **shape: Any) -> None:
    """Add a terrain's body with its one geom; `shape` holds the geom's attributes of type and size."""
    spec.worldbody.add_body(name=BODY).add_geom(
        name=BODY,
        friction=list(friction),
        material=MATERIAL,
        # The robot's default class would apply otherwise, which may collide with nothing.
        contype=1,
        conaffinity=1,
        condim=3,
        rgba=[0.5, 0.5, 0.5, 1.0],
        **shape,
    )


@dataclass(frozen=True, kw_only=True)
class Terrain(ABC):
    """The ground of a scene: one static body with one geom, both called "terrain"."""

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        """The MuJoCo model fields that differ between worlds."""
        return ()

    @abstractmethod
    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add body, geom and looks to the scene's spec."""

    def ground(self, view: EnvView) -> Ground:
        """Return the ground of the worlds of `view` (flat, at z = 0, by default)."""
        return Ground(view.num_envs, view.device)
