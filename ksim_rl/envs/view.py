"""The view that terms read: the worlds, and values that sensors and managers compute from them."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.scene.sensors import (
    CameraTracker,
    ContactPointsState,
    ContactPointsTracker,
    ContactState,
    ContactTracker,
    ImuTracker,
    RayTracker,
    SensorTracker,
)
from ksim_rl.scene.state.simulation import Simulation
from ksim_rl.scene.state.world_view import WorldView

Tracker = TypeVar("Tracker", bound=SensorTracker)


class Readings:
    """Values of an `EnvView` beyond the worlds; managers fill it while the env is constructed, then write in place."""

    def __init__(self, simulation: Simulation) -> None:
        num_envs = simulation.num_envs
        device = simulation.device
        self.sensors: dict[str, SensorTracker] = {}
        self.commands: dict[str, Float[Tensor, "E ?K"]] = {}
        self.command_ranges: dict[str, dict[str, Float[Tensor, " 2"]]] = {}
        self.reward_weights: dict[str, Float[Tensor, ""]] = {}
        self.stages: dict[str, Float[Tensor, ""]] = {}
        self.episode_rewards: dict[str, Float[Tensor, " E"]] = {}
        self.terminations: dict[str, Bool[Tensor, " E"]] = {}
        # The termination manager writes both in place at each step.
        self.terminated_E = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.truncated_E = torch.zeros_like(self.terminated_E)
        # No columns yet: the action manager puts its buffers here.
        self.action_EL = torch.zeros(num_envs, 0, device=device)
        self.last_action_EL = torch.zeros_like(self.action_EL)
        # Saved with the env, as it is the state of a curriculum.
        self.level = simulation.shared_values.get("curriculum.level", 1.0)
        self.command_cache = simulation.new_cache()


class EnvView(WorldView):
    """The typed view of an env that each term is called with: a `WorldView` with sensors, commands and rewards.

    All that a term can read, with shapes, units, frames and stages, is in docs/view.md.

    Attributes:
        sensors: the readers of `scene.sensors` by name; `contact`, `imu`, `rays` and `camera` give them by kind.
        commands: by name, [E, K] each, as the policy saw them before this step.
        command_ranges: by command and field, (low, high) [2] each; a curriculum may change these in place.
        reward_weights: by term, [] each; a curriculum may change these in place.
        stages: by term ("rewards/upright"), which of its stages holds, [] each; as above.
        episode_rewards: by term, the weighted sum over the episode so far, [E] each.
        terminations: by term, and "non_finite": which envs end, bool [E], as the step found it.
        terminated_E: which envs the step found to end by a condition that is no time-out, bool [E].
        truncated_E: which envs the step found to end by a time-out, bool [E], whatever `is_finite_horizon` says.
        level: the difficulty in [0, 1] that a curriculum drives, [] on the device; 1 where none does. It is one tensor
            for the life of the env, changed in place, so that a term that scales with difficulty may keep it.
        command_cache: values that depend on commands only; emptied when these change.
    """

    def __init__(self, simulation: Simulation, readings: Readings, **parts: Any) -> None:
        super().__init__(simulation, **parts)
        self._readings = readings
        # Managers hold on to the tensors: one that were put in the place of another would have no effect.
        self.sensors: Mapping[str, SensorTracker] = MappingProxyType(readings.sensors)
        self.commands: Mapping[str, Float[Tensor, "E ?K"]] = MappingProxyType(readings.commands)
        self.command_ranges: Mapping[str, Mapping[str, Float[Tensor, " 2"]]] = MappingProxyType(
            readings.command_ranges
        )
        self.reward_weights: Mapping[str, Float[Tensor, ""]] = MappingProxyType(
            readings.reward_weights
        )
        self.stages: Mapping[str, Float[Tensor, ""]] = MappingProxyType(readings.stages)
        self.episode_rewards: Mapping[str, Float[Tensor, " E"]] = MappingProxyType(
            readings.episode_rewards
        )
        self.terminations: Mapping[str, Bool[Tensor, " E"]] = MappingProxyType(
            readings.terminations
        )
        self.terminated_E = readings.terminated_E
        self.truncated_E = readings.truncated_E
        # The same tensor for the life of the env, so it needs no property.
        self.level = readings.level
        self.command_cache = readings.command_cache

    @property
    def action_EL(self) -> Float[Tensor, "E L"]:
        """The action of this step; rows whose action was not finite hold their last one."""
        return self._readings.action_EL

    @property
    def last_action_EL(self) -> Float[Tensor, "E L"]:
        """The action of the step before."""
        return self._readings.last_action_EL

    def contact(self, name: str) -> ContactState:
        """Return the state of a contact sensor of `cfg.scene.sensors`."""
        return self.tracker(name, ContactTracker, "contact sensor").state

    def contact_points(self, name: str) -> ContactPointsState:
        """Return the contacts that a `ContactPoints` of `cfg.scene.sensors` sees, one by one."""
        return self.tracker(name, ContactPointsTracker, "ContactPoints").state

    def imu(self, name: str) -> ImuTracker:
        """Return an `ImuSensor` of `cfg.scene.sensors`, which has its readings."""
        return self.tracker(name, ImuTracker, "IMU")

    def rays(self, name: str) -> RayTracker:
        """Return a `RayCaster` of `cfg.scene.sensors`; its rays are cast when they are read."""
        return self.tracker(name, RayTracker, "ray caster")

    def camera(self, name: str) -> CameraTracker:
        """Return a `CameraSensor` of `cfg.scene.sensors`; its pictures are drawn when they are read."""
        return self.tracker(name, CameraTracker, "camera")

    def tracker(self, name: str, kind: type[Tracker], described: str) -> Tracker:
        """Return the reader of a sensor of `cfg.scene.sensors`; a ValueError if there is none of this kind."""
        tracker = self.sensors.get(name)
        if not isinstance(tracker, kind):
            # Suggest sensors of the right kind only.
            names = [other for other, present in self.sensors.items() if isinstance(present, kind)]
            raise ValueError(f"no {described} {name!r} in scene.sensors: {near(name, names)}")
        return tracker

    def command(self, name: str) -> Float[Tensor, "E K"]:
        """Return the command that the policy saw before this step, [E, K]."""
        if name not in self.commands:
            raise ValueError(f"no command {name!r} in commands: {near(name, self.commands)}")
        return self.commands[name]
