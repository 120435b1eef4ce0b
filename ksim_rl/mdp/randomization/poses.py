"""These events draw where bodies, geoms, sites, cameras and lights stand in their frames, and how they are turned."""

from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as default
from typing import Literal, get_args

import mujoco
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant
from ksim_rl.mdp.fields import OfSites
from ksim_rl.mdp.randomization.randomize import (
    Operation,
    Pair,
    RandomizeField,
    RandomizeModelField,
    write_entries,
)
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns

Angle = Literal["roll", "pitch", "yaw"]


@dataclass(frozen=True, kw_only=True)
class RandomizePos(RandomizeModelField):
    """Position of elements in the frame of their body, m; columns x, y, z."""

    columns = 3

    operation: Operation = "add"


@dataclass(frozen=True, kw_only=True)
class RandomizeTurn(RandomizeField):
    """Orientation of elements in the frame of their body: turned about their own axes by `ranges`, rad.

    The turn is Rz(yaw) Ry(pitch) Rx(roll), after the model's own orientation ("add"), or in its place ("abs").
    """

    columns = 4

    ranges: Mapping[Angle, Pair] = default(default_factory=dict)
    operation: Literal["abs", "add"] = "add"

    def _check_fields(self) -> None:
        super()._check_fields()
        for angle, pair in self.ranges.items():
            self.check_range(f"ranges.{angle}", pair)
        # Angles without a range are drawn from (0, 0), which a logarithm does not take.
        missing = [angle for angle in get_args(Angle) if angle not in self.ranges]
        if self.distribution == "log_uniform" and missing:
            raise ValueError(
                f"distribution='log_uniform': ranges needs all of {get_args(Angle)}, {missing[0]!r} is missing"
            )

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        ids = self.ids(view)
        own_NC = array_constant(self.nominal(view), view.device)
        # All three angles, in the order of the turn; left-out ones are 0.
        pairs = [self.ranges.get(angle, (0.0, 0.0)) for angle in get_args(Angle)]
        turn_EN4 = quaternion.from_euler_xyz(*self.draw(view, len(ids), pairs).unbind(-1))
        value_ENC = self._turned(own_NC[None], turn_EN4)
        write_entries(view.field(self.field), ids, range(self.columns), mask_E, value_ENC)

    def _turned(self, own_1NC: Tensor, turn_EN4: Tensor) -> Tensor:
        # In the orientation's place: the model's own plays no part.
        if self.operation == "abs":
            return turn_EN4
        # On the right: about the element's own axes.
        return quaternion.multiply(own_1NC, turn_EN4)


@dataclass(frozen=True, kw_only=True)
class OfBodies(RandomizeField):
    """Draw a pose of bodies, in the frame of their parents, with all that hangs on them."""

    bodies: Patterns

    def ids(self, view: EnvView) -> tuple[int, ...]:
        model = view.world.mj_model
        # A body that moves freely has its pose in qpos, where the model's field counts for nothing.
        ids = super().ids(view)
        for body in ids:
            # A body's first joint decides; a free joint is always alone.
            free = model.jnt_type[model.body_jntadr[body]] == mujoco.mjtJoint.mjJNT_FREE
            if model.body_mocapid[body] >= 0 or (model.body_jntnum[body] and free):
                raise ValueError(
                    f"{type(self).__name__}.bodies: {model.body(body).name!r} moves freely, so that its pose is state: "
                    "draw it at resets (ResetRootUniform)"
                )
        return ids


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyPos(OfBodies, RandomizePos):
    """Position of bodies in the frame of their parents, m; columns x, y, z. The bodies below them move along."""

    field = "body_pos"


@dataclass(frozen=True, kw_only=True)
class RandomizeBodyQuat(OfBodies, RandomizeTurn):
    """Orientation of bodies in their parents, rad by angle, about their own axes. The bodies below them turn along."""

    field = "body_quat"


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomPos(RandomizePos):
    """Position of geoms in the frame of their body, m; columns x, y, z. The body's inertia does not change."""

    field = "geom_pos"

    geoms: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeGeomQuat(RandomizeTurn):
    """Orientation of geoms in their body, rad by angle, about their own axes. The body's inertia does not change."""

    field = "geom_quat"

    geoms: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeSitePos(OfSites, RandomizePos):
    """Position of sites in the frame of their body, m; columns x, y, z. Their sensors and forces move along."""

    field = "site_pos"


@dataclass(frozen=True, kw_only=True)
class RandomizeSiteQuat(OfSites, RandomizeTurn):
    """Orientation of sites in their body, rad by angle, about their own axes: an IMU that is mounted askew, say."""

    field = "site_quat"


@dataclass(frozen=True, kw_only=True)
class RandomizeCameraPos(RandomizePos):
    """Position of the model's cameras in the frame of their body, m; columns x, y, z."""

    field = "cam_pos"

    cameras: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeCameraQuat(RandomizeTurn):
    """Orientation of the model's cameras in their body, rad by angle, about their own axes; they look along -z."""

    field = "cam_quat"

    cameras: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeLightPos(RandomizePos):
    """Position of lights in the frame of their body, m; columns x, y, z."""

    field = "light_pos"

    lights: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeLightDir(RandomizeTurn):
    """Direction of lights in the frame of their body, turned about its axes, rad by angle."""

    field = "light_dir"
    columns = 3

    lights: Patterns
    operation: Literal["add"] = "add"

    def _turned(self, own_1NC: Tensor, turn_EN4: Tensor) -> Tensor:
        # A light has a direction instead of a quaternion, [E, N, 3].
        return quaternion.rotate(turn_EN4, own_1NC)
