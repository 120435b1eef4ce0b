"""The sensors of a scene, one file each; terms read them by name through the view."""

from ksim_rl.scene.sensors.camera import CameraSensor, CameraTracker
from ksim_rl.scene.sensors.contact import ContactSensor, ContactState, ContactTracker
from ksim_rl.scene.sensors.contact_points import (
    ContactPoints,
    ContactPointsState,
    ContactPointsTracker,
)
from ksim_rl.scene.sensors.imu import ImuSensor, ImuTracker
from ksim_rl.scene.sensors.rays import (
    GridPattern,
    PinholePattern,
    RayCaster,
    RayPattern,
    RayState,
    RayTracker,
    RingPattern,
)
from ksim_rl.scene.sensors.sensor import Sensor, SensorTracker

__all__ = sorted(name for name, value in vars().items() if isinstance(value, type))  # pyright: ignore
