"""A bench for sensors: a few worlds of a small model, and their view."""

from collections.abc import Mapping
from typing import Any

import mujoco
import torch

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.physics import World, load_model, prepare_spec
from ksim_rl.scene.sensors import Sensor

SUBSTEPS = 10


class SensorBench:
    """Worlds and their view, with what the env does around sensors."""

    def __init__(
        self,
        source: str,
        num_envs: int,
        sensors: Mapping[str, Sensor],
        *,
        step_dt: float | None = None,
        view: Mapping[str, float] | None = None,
        per_world_fields: tuple[str, ...] = (),
        device: str = "cpu",
        **world: Any,
    ) -> None:
        spec = mujoco.MjSpec.from_string(source)
        for name, sensor in sensors.items():
            sensor.add_to(spec, name)
        prepare_spec(spec, per_world_fields)
        self.world = World(
            load_model(spec),
            num_envs=num_envs,
            per_world_fields=per_world_fields,
            device=device,
            **world,
        )
        self.driver = EnvDriver(
            self.world, step_dt=step_dt or SUBSTEPS * self.world.timestep, **view or {}
        )
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
        """Advance by one env step, clocks of sensors included."""
        self.view.step_count.add_(1)
        driver = self.driver
        self.world.step(
            substeps,
            before=driver.before_substep,
            after=driver.after_substep,
            sensors=driver.substep_sensors,
        )
        driver.keep_moment_of_contacts()
        self.refresh()
        self.view.episode_step_E.add_(1)
        for tracker in self.view.sensors.values():
            tracker.update()
