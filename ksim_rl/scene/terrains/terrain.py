"""The base of all terrains: a config edits the model, and makes the ground that terms read."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import mujoco
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Checked, Filled, NonNegative, Positive
from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.state.world_view import WorldView

Friction = tuple[NonNegative, NonNegative, NonNegative]
"""Sliding (1), torsional (m) and rolling (m) coefficients, as in MJCF."""
MATERIAL = "terrain"
BODY = "terrain"
"""Name of the body, and of the geom, that a terrain adds to the world."""


def add_look(spec: mujoco.MjSpec, *, repeat: float) -> None:
    """Add sky (unless there is one), light and the material `MATERIAL`, whose pattern repeats so often per metre."""
    # A second sky would not be shown; a robot's own scene may have one.
    if not any(texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
        spec.add_texture(
            name="terrain_sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[0.75, 0.82, 0.9],
            rgb2=[0.95, 0.97, 1.0],
            width=64,
            height=384,
        )
    spec.add_texture(
        name=MATERIAL,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.28, 0.32, 0.36],
        rgb2=[0.22, 0.25, 0.29],
        width=256,
        height=256,
    )
    # One texture per role, and only the colour's is set.
    textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = MATERIAL
    # Uniform: the pattern is measured in metres, not stretched over the geom.
    spec.add_material(name=MATERIAL, textures=textures, texuniform=True, texrepeat=[repeat, repeat])
    # A directional light shines alike on all of the ground.
    spec.worldbody.add_light(
        pos=[0, 0, 4], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    )


def add_ground(
    spec: mujoco.MjSpec,
    *,
    friction: Sequence[float],
    **shape: mujoco.mjtGeom | Sequence[float] | str,
) -> None:
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
class Terrain(Checked, ABC):
    """The ground of a scene: one static body and its geom, both called "terrain"."""

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        """The MuJoCo model fields that differ between worlds."""
        return ()

    @abstractmethod
    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add body, geom and looks to the scene's spec."""

    def ground(self, view: WorldView) -> Ground:
        """Return the ground of the worlds of `view` (flat, at z = 0, by default)."""
        return Ground(view.num_envs, view.device)


@dataclass(frozen=True, kw_only=True)
class PlaneTerrain(Terrain):
    """An infinite plane at z = 0: body and geom are both called "terrain"."""

    friction: Friction = (1.0, 0.005, 0.0001)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        add_look(spec, repeat=2)
        # Size 0 along x and y means without end; the third number is the spacing of the grid that is drawn.
        add_ground(
            spec, friction=self.friction, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.01]
        )


@dataclass(frozen=True, kw_only=True)
class GroundBox(Checked):
    """A box on the ground: x and y of its middle, and its edges along x, y and z, m."""

    pos: tuple[float, float] = (0.0, 0.0)
    size: tuple[Positive, Positive, Positive]


@dataclass(frozen=True, kw_only=True)
class PlaneWithBoxes(PlaneTerrain):
    """An infinite plane at z = 0 with boxes on it, the same in all worlds: steps, or seats.

    The boxes are geoms "terrain_box0", "terrain_box1", ... of the body "terrain". What terms read as the ground's
    height is the top of the highest box at that place.
    """

    boxes: Annotated[tuple[GroundBox, ...], Filled("name a box, or take PlaneTerrain")]

    def add_to(self, spec: mujoco.MjSpec) -> None:
        super().add_to(spec)
        for number, box in enumerate(self.boxes):
            half = [edge / 2 for edge in box.size]
            spec.body(BODY).add_geom(
                name=f"{BODY}_box{number}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[*box.pos, half[2]],
                size=half,
                friction=list(self.friction),
                # As the plane, which has none: sums over the whole model are then of what moves.
                mass=0.0,
                contype=1,
                conaffinity=1,
                condim=3,
                rgba=[0.55, 0.5, 0.45, 1.0],
            )

    def ground(self, view: WorldView) -> Ground:
        """Return the ground of the worlds of `view`: 0, and on a box its top."""
        return BoxedGround(view.num_envs, view.device, self.boxes)


class BoxedGround(Ground):
    """The ground of a plane with boxes."""

    is_flat = False

    def __init__(self, num_envs: int, device: torch.device, boxes: Sequence[GroundBox]) -> None:
        super().__init__(num_envs, device)
        self._boxes = tuple(boxes)

    def heights(self, points_EN2: Float[Tensor, "E N 2"]) -> Float[Tensor, "E N"]:
        """Return the height of the ground at x, y (world frame, m), m."""
        x_EN, y_EN = points_EN2.unbind(-1)
        height_EN = torch.zeros_like(x_EN)
        for box in self._boxes:
            on_x_EN = (x_EN - box.pos[0]).abs() <= box.size[0] / 2
            on_y_EN = (y_EN - box.pos[1]).abs() <= box.size[1] / 2
            top_EN = torch.where(on_x_EN & on_y_EN, box.size[2], 0.0)
            height_EN = torch.maximum(height_EN, top_EN)
        return height_EN
