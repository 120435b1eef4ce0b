"""These observations read inertial measurement units and cameras."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from jaxtyping import Float, Shaped
from torch import Tensor

from ksim_rl.checks import check_choice
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

    def __post_init__(self) -> None:
        check_choice("quantity", self.quantity, IMU_QUANTITIES)

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

    def __post_init__(self) -> None:
        check_choice("output", self.output, CAMERA_OUTPUTS)

    def __call__(self, view: EnvView) -> Shaped[Tensor, " E *image"]:
        camera = view.camera(self.sensor)
        return camera.rgb_EHW3 if self.output == "rgb" else getattr(camera, f"{self.output}_EHW")
