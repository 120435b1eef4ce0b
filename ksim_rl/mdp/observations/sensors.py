"""Each of these observations has the readings of an inertial measurement unit, a camera or a ray caster."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from jaxtyping import Float, Shaped
from torch import Tensor

from ksim_rl.checked import Range
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView

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
