"""Inertial measurement units: gyroscope, accelerometer and orientation at a place on a body."""

from dataclasses import dataclass

import mujoco
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.scene import quaternion
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.sensors.sensor import MountedSensor, SensorTracker
from ksim_rl.scene.state.world_view import WorldView

_SENSORS = {
    "gyro": mujoco.mjtSensor.mjSENS_GYRO,
    "accelerometer": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
    "orientation": mujoco.mjtSensor.mjSENS_FRAMEQUAT,
}


@dataclass(frozen=True, kw_only=True)
class ImuSensor(MountedSensor):
    """An inertial measurement unit. Noise, bias and lag are transforms of the observations that read it."""

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add the MJCF sensors `<name>_gyro`, `<name>_accelerometer` and `<name>_orientation`, and a site if needed."""
        # The site first, if the sensor brings one: the others are attached to it.
        super().add_to(spec, name)
        for suffix, kind in _SENSORS.items():
            spec.add_sensor(
                name=f"{name}_{suffix}",
                type=kind,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname=self.mounting_site(name),
            )

    def track(self, name: str, view: WorldView) -> "ImuTracker":
        return ImuTracker(name, view, self.mounting_site(name))


class ImuTracker(SensorTracker):
    """The readings of one inertial measurement unit, float32, in its own axes."""

    def __init__(self, name: str, view: WorldView, site: str) -> None:
        self._name = name
        self._view = view
        self._site = site
        # World -z: gravity's direction, whatever its strength.
        self._down = torch.tensor([0.0, 0.0, -1.0], device=view.device)

    @property
    def ang_vel_EL(self) -> Float[Tensor, "E 3"]:
        """Angular velocity, rad/s, sensor frame; velocity stage."""
        return self._view.sensor(f"{self._name}_gyro")

    @property
    def lin_acc_EL(self) -> Float[Tensor, "E 3"]:
        """Acceleration minus gravity (at rest 9.81 up), m/s^2, sensor frame; acceleration stage."""
        # MuJoCo computes it in the substep, so that it lags behind a state that was just written.
        return self._view.sensor(f"{self._name}_accelerometer")

    @property
    def quat_EL(self) -> Float[Tensor, "E 4"]:
        """Orientation, sensor to world, (w, x, y, z); position stage."""
        return self._view.sensor(f"{self._name}_orientation")

    @property
    def projected_gravity_EL(self) -> Float[Tensor, "E 3"]:
        """Direction of world -z, a unit vector, sensor frame; position stage."""
        cache = self._view.cache
        key = f"imu/{self._name}.projected_gravity"
        # Computed once per state, however many terms read it.
        if key not in cache:
            cache[key] = quaternion.rotate_inverse(
                self.quat_EL, self._down.expand(self._view.num_envs, 3)
            )
        return cache[key]

    def draw_debug(self, view: WorldView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the unit's axes at its place."""
        site = view.world.mj_model.site(self._site).id
        # Pictures are drawn on the host.
        origin = view.world.site_xpos_EL[env_index, site].cpu().numpy()
        visualizer.frame(
            origin, view.world.site_xmat_EL[env_index, site].cpu().numpy().reshape(3, 3)
        )
