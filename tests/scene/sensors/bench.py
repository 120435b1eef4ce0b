"""A bench for sensors: a few worlds of a small model, and their view."""

from collections.abc import Mapping

import mujoco
import torch

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.physics import World, load_model
from ksim_rl.scene.sensors import Sensor

SUBSTEPS = 10


class SensorBench:
    """Worlds and their view, with what the env does around sensors."""

    def __init__(
        self, source: str, num_envs: int, sensors: Mapping[str, Sensor], *, device: str = "cpu", **world
    ) -> None:
        spec = mujoco.MjSpec.from_string(source)
        for name, sensor in sensors.items():
            sensor.add_to(spec, name)
        self.world = World(load_model(spec), num_envs=num_envs, device=device, **world)
        self.driver = EnvDriver(self.world, step_dt=SUBSTEPS * self.world.timestep)
        self.view = self.driver.view
        self.driver.add_sensors(sensors)

    def place(self, qpos=None, qvel=None) -> None:
        """Write states [E, L] or [L], and refresh what derives from them."""
        for target, value in ((self.world.qpos_EL, qpos), (self.world.qvel_EL, qvel)):
            if value is not None:
                target.copy_(torch.as_tensor(value, dtype=torch.float32).expand_as(target))
        self.refresh()

    def refresh(self) -> None:
        self.world.refresh()
        self.driver.refreshed()

    def step(self, substeps: int = SUBSTEPS) -> None:
        """Advance by one env step."""
        driver = self.driver
        self.world.step(
            substeps,
            before=driver.before_substep,
            after=driver.after_substep,
            sensors=driver.substep_sensors,
        )
        self.refresh()
        for tracker in self.view.sensors.values():
            tracker.update()
