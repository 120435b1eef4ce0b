"""Each of these observations has the readings of an IMU, a camera, a ray caster or a height scan."""

from dataclasses import dataclass
from functools import cache
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from ksim_rl.checked import Positive, Range, Within
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import OfEntity
from ksim_rl.scene.sensors.rays import grid_points

IMU_QUANTITIES = ("ang_vel", "lin_acc", "quat", "projected_gravity")
CAMERA_OUTPUTS = ("rgb", "depth", "segmentation")


@dataclass(frozen=True, kw_only=True)
class ImuReading(ObservationTerm):
    """One quantity of an inertial measurement unit, in its own axes, float32 [E, 3], or [E, 4] for "quat".

    Attributes:
        sensor: an `ImuSensor` of `scene.sensors`.
        quantity: "ang_vel" (rad/s; velocity stage), "lin_acc" (m/s^2, +9.81 upwards at rest; acceleration stage),
            "quat" ((w, x, y, z), to the world; position stage) or "projected_gravity" (unit vector; position stage).
    """

    sensor: str
    quantity: Literal["ang_vel", "lin_acc", "quat", "projected_gravity"] = "ang_vel"

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return getattr(view.imu(self.sensor), f"{self.quantity}_EL")


@dataclass(frozen=True, kw_only=True)
class CameraImage(ObservationTerm):
    """What a camera sees of the current state (position stage); the only term of its observation group.

    Attributes:
        sensor: a `CameraSensor` of `scene.sensors`.
        output: "rgb" (uint8 [E, H, W, 3]), "depth" (m, float32 [E, H, W]) or "segmentation" (ids of geoms, -1 for none,
            int32 [E, H, W]).
    """

    is_image: ClassVar[bool] = True

    sensor: str
    output: Literal["rgb", "depth", "segmentation"] = "rgb"

    def __call__(self, view: EnvView) -> Shaped[Tensor, " E *image"]:
        camera = view.camera(self.sensor)
        return camera.rgb_EHW3 if self.output == "rgb" else getattr(camera, f"{self.output}_EHW")


@dataclass(frozen=True, kw_only=True)
class RayDistance(ObservationTerm):
    """Distances to what the rays hit, m, the sensor's `max_distance` where they hit nothing, [E, N]; position stage."""

    sensor: str

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.rays(self.sensor).state.distance_EN


@dataclass(frozen=True, kw_only=True)
class RayHeight(ObservationTerm):
    """How far the ends of the rays are below the sensor, minus `offset`, clipped, m, [E, N]; position stage.

    With a `GridPattern` that starts well above the robot it is a height scan that sees everything, not only terrain.

    Attributes:
        offset: m.
        clip: readings are clipped to this range, m.
    """

    sensor: str
    offset: float = 0.0
    clip: Range = (-1.0, 1.0)

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        tracker = view.rays(self.sensor)
        below_EN = tracker.origin_E3[:, 2:] - tracker.state.point_EN3[..., 2] - self.offset
        return below_EN.clamp(*self.clip)


@dataclass(frozen=True, kw_only=True)
class HeightScan(OfEntity, ObservationTerm):
    """How far the ground is below the root at the points of a grid, minus `offset`, clipped, m, [E, L]; position stage.

    The grid is centred on the root and turns with its yaw only. Points run along x (forward) first, from back to front,
    and these rows along y, from right to left. Heights are those of the terrain itself, exactly and without casting
    rays: of what else stands there nothing is seen (`scene.sensors` with a `RayCaster` does). Ground that is higher
    reads lower; on flat ground all points read root height - offset.

    Attributes:
        size: edges of the grid along x and y, m.
        resolution: m between neighbouring points.
        offset: m, about the root's height on flat ground, so that readings are around zero.
        clip: readings are clipped to this range, m.
    """

    size: Annotated[tuple[float, float], Within(low=0.0)] = (1.6, 1.0)
    resolution: Positive = 0.1
    offset: float = 0.5
    clip: Range = (-1.0, 1.0)

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        body = view.entity(self.entity)
        x_N, y_N = _grid(tuple(self.size), self.resolution, view.device)
        sin_E1, cos_E1 = torch.sin(body.heading_E)[:, None], torch.cos(body.heading_E)[:, None]
        root_E3 = body.root_pos_EL
        points_EN2 = root_E3[:, None, :2] + torch.stack(
            (cos_E1 * x_N - sin_E1 * y_N, sin_E1 * x_N + cos_E1 * y_N), dim=-1
        )
        below_EN = root_E3[:, 2:] - view.terrain.heights(points_EN2) - self.offset
        return below_EN.clamp(*self.clip)


@cache
def _grid(size: tuple[float, float], resolution: float, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return x and y of the points about the root, m, [N] each, on the device; made once."""
    x_N, y_N, _ = grid_points(size, resolution).T.tolist()
    return constant(x_N, device), constant(y_N, device)
