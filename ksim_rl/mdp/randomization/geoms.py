"""These events draw friction, size and pose of geoms."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import mujoco
import numpy as np
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checks import unknown_name
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant
from ksim_rl.mdp.randomization.randomize import (
    Operation,
    Pair,
    Randomize,
    RandomizeModelField,
    write_entries,
)
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns

# How many of its three sizes a geom of each kind has; those of other kinds cannot differ between worlds.
NUM_SIZES = {
    mujoco.mjtGeom.mjGEOM_SPHERE: 1,
    mujoco.mjtGeom.mjGEOM_CAPSULE: 2,
    mujoco.mjtGeom.mjGEOM_CYLINDER: 2,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: 3,
    mujoco.mjtGeom.mjGEOM_BOX: 3,
}
ANGLES = ("roll", "pitch", "yaw")


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomField(RandomizeModelField):
    """Draw entries of a field of geoms per world.

    Attributes:
        geoms: names or patterns.
    """

    geoms: Patterns

    kind: ClassVar[str] = "geom"

    @property
    def elements(self) -> Patterns:
        return self.geoms


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomFriction(RandomizeGeomField):
    """Friction of geoms; columns: 0 sliding, 1 torsional (m), 2 rolling (m)."""

    field: ClassVar[str] = "geom_friction"
    columns: ClassVar[int] = 3
    lowest: ClassVar[float | None] = 0.0


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomSize(RandomizeGeomField):
    """Sizes of primitive geoms, m, in MuJoCo's columns: radius, half length; or half sizes x, y, z.

    Bounding boxes and spheres follow; mass and inertia do not.
    """

    field: ClassVar[str] = "geom_size"
    columns: ClassVar[int] = 3

    def _check_reach(self, view: EnvView, nominal: np.ndarray, pairs: Mapping[int, Pair]) -> None:
        model = view.world.mj_model
        for row, geom in enumerate(self.ids(view)):
            kind = mujoco.mjtGeom(int(model.geom_type[geom]))
            count = NUM_SIZES.get(kind, 0)
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


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomPos(RandomizeGeomField):
    """Position of geoms in the frame of their body, m; columns x, y, z. The body's inertia does not change."""

    field: ClassVar[str] = "geom_pos"
    columns: ClassVar[int] = 3
    operation: Operation = "add"


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomQuat(Randomize):
    """Orientation of geoms in their body: turned about their own axes. The body's inertia does not change.

    Attributes:
        geoms: names or patterns.
        ranges: rad, by angle: "roll", "pitch", "yaw". The turn is Rz(yaw) Ry(pitch) Rx(roll), after the model's own
            orientation ("add"), or in its place, from the axes of the body ("abs").
    """

    geoms: Patterns
    ranges: Mapping[str, Pair] = field(default_factory=dict)
    operation: Operation = "add"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.operation == "scale":
            raise ValueError("operation='scale': an orientation cannot be scaled; valid: abs, add")
        for angle, pair in self.ranges.items():
            if angle not in ANGLES:
                raise unknown_name("angle in ranges", angle, ANGLES)
            self.check_range(f"ranges.{angle}", pair)
        missing = [angle for angle in ANGLES if angle not in self.ranges]
        if self.distribution == "log_uniform" and missing:
            raise ValueError(
                f"distribution='log_uniform': ranges needs all of {ANGLES}, {missing[0]!r} is missing"
            )

    per_world_fields: ClassVar[tuple[str, ...]] = ("geom_quat",)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        ids = view.resolver.ids("geom", self.geoms)
        pairs = [self.ranges.get(angle, (0.0, 0.0)) for angle in ANGLES]
        turn_EN4 = quaternion.from_euler_xyz(*self.draw(view, len(ids), pairs).unbind(-1))
        if self.operation == "add":
            own = view.world.mj_model.geom_quat[list(ids)]
            turn_EN4 = quaternion.multiply(array_constant(own, view.device)[None], turn_EN4)
        write_entries(view.field("geom_quat"), ids, range(4), mask_E, turn_EN4)
