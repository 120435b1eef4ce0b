"""A bench for terms: a few worlds of a small model, put into states whose answers are known in closed form."""

from collections.abc import Mapping

import torch
from torch import Tensor

from ksim_rl.scene.sensors import Sensor
from ksim_rl.scene.state.ground import Ground
from tests.scene.sensors.bench import SensorBench

FREE_BODY = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    <body name="trunk">
      <freejoint name="root"/>
      <inertial pos="0.1 0.2 -0.1" mass="2" diaginertia="0.02 0.03 0.04"/>
      <geom name="hull" type="box" size="0.1 0.1 0.1" contype="0" conaffinity="0"/>
      <site name="imu" pos="0.3 0 0"/>
      <body name="left" pos="0 0.2 0">
        <inertial pos="0 0 0" mass="0.1" diaginertia="0.001 0.001 0.001"/>
        <joint name="left_hip" axis="0 1 0" range="-1 1" limited="true"/>
        <site name="left_foot" pos="0 0 -0.4"/>
      </body>
      <body name="right" pos="0 -0.2 0">
        <inertial pos="0 0 0" mass="0.1" diaginertia="0.001 0.001 0.001"/>
        <joint name="right_hip" axis="0 1 0" range="0 2" limited="true"/>
        <site name="right_foot" pos="0 0 -0.4"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="right" joint="right_hip" kp="10"/>
    <motor name="left" joint="left_hip" ctrllimited="true" ctrlrange="-2 3" gear="4"/>
  </actuator>
  <sensor>
    <gyro name="gyro" site="imu"/>
    <velocimeter name="velocimeter" site="imu"/>
    <subtreeangmom name="angmom" body="trunk"/>
  </sensor>
  <keyframe><key name="stand" qpos="1 2 3 1 0 0 0 0.25 0.5"/></keyframe>
</mujoco>
"""
"""A trunk in free flight with two legs; joints and actuators stand in opposite orders."""

BOXES = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -10"/>
  <worldbody>
    <body name="terrain"><geom name="terrain" type="plane" size="0 0 0.01"/></body>
    <body name="a" pos="0 0 0.1">
      <freejoint/>
      <geom name="a" type="box" size="0.1 0.1 0.1" mass="3"/>
      <site name="a"/>
    </body>
    <body name="b" pos="1 0 0.1">
      <freejoint/>
      <geom name="b" type="box" size="0.1 0.1 0.1" mass="1"/>
      <site name="b"/>
    </body>
  </worldbody>
</mujoco>
"""
"""Two boxes on a plane, at rest or in the air."""

TWO_WHEELS = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody>
    <body name="left"><joint name="left" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 .5"/></body>
    <body name="right"><joint name="right" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 .25"/></body>
  </worldbody>
  <actuator><motor name="right" joint="right"/><motor name="left" joint="left" gear="2"/></actuator>
</mujoco>
"""
"""Two wheels of 0.5 and 0.25 kg m^2 without friction; joints and actuators stand in opposite orders."""


class Plateau(Ground):
    """Flat ground that is 0.25 m high."""

    is_flat = False

    def heights(self, points_EN2: Tensor) -> Tensor:
        return torch.full_like(points_EN2[..., 0], 0.25)


class Bench(SensorBench):
    """Worlds and their view, with what the env does around terms; a step takes 20 ms."""

    def __init__(
        self, source: str, num_envs: int, contacts: Mapping[str, Sensor], **view: float
    ) -> None:
        self.per_world = ("geom_friction", "body_ipos")
        super().__init__(
            source, num_envs, contacts, step_dt=0.02, view=view, per_world_fields=self.per_world
        )
        self.everybody_E = torch.ones(num_envs, dtype=torch.bool)

    def command(self, values) -> None:
        """Set the command "twist" [E, 3] or [3]."""
        value = torch.as_tensor(values, dtype=torch.float32)
        self.driver.readings.commands["twist"] = value.expand(self.world.num_envs, 3).clone()
        self.view.command_cache.clear()

    def read(self, term, scope: str = "observations/x") -> Tensor:
        with self.driver.scope(scope):
            return term(self.view)

    def fire(self, event, mask_E: Tensor | None = None, scope: str = "events/x") -> None:
        """Run an event for some rows (all by default), and refresh."""
        with self.driver.scope(scope):
            event(self.view, self.everybody_E if mask_E is None else mask_E)
        self.refresh()
