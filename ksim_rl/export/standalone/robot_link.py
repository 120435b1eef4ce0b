"""The interface between a loop and a robot: measurements one way, commands of joints the other."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from ksim_rl.export.standalone.commands import CommandRange
from ksim_rl.export.standalone.description import Export, JointsSpec
from ksim_rl.export.standalone.files import Array, Json


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """A robot's measurements at one moment; arrays have the joints of `joints.names` in export.json, in this order.

    Attributes:
        stamp: when it arrived, s of `time.monotonic`.
        joint_pos: rad, or m for slides.
        joint_vel: per second.
        joint_effort: N m, or N.
        root_quat: attitude of the root (w, x, y, z); None of a robot that is fixed to the world.
        root_ang_vel: rad/s, in the root's own axes: x forward, y left, z up.
        count: the robot's own number or time of the state that it sent, where it has one: it stands still where its
            firmware sends one state again and again.
        estimates: what else `obs.onnx` reads, by the names of its inputs, such as `sensor_imu_ang_vel`.
        pictures: the newest of each camera, by the inputs of `policy.onnx`; see `pictures` in export.json.
        picture_stamps: when each of them was taken, s of `time.monotonic`, of cameras that tell it; without it a camera
            counts as frozen where its pictures stay equal to the bit.
    """

    stamp: float
    joint_pos: Array
    joint_vel: Array
    joint_effort: Array
    root_quat: Array | None = None
    root_ang_vel: Array | None = None
    count: int | None = None
    estimates: Mapping[str, Array] = field(default_factory=dict)
    pictures: Mapping[str, Array] = field(default_factory=dict)
    picture_stamps: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class JointCommand:
    """Targets and gains of the motors, by joint, in the order of `joints.names`; a joint without a motor has zeros.

    A motor exerts `effort + stiffness * (pos - measured pos) + damping * (vel - measured vel)`.
    """

    pos: Array
    vel: Array
    effort: Array
    stiffness: Array
    damping: Array


class Robot(Protocol):
    """The methods that a loop needs of a robot; none of them may block."""

    def read(self) -> Measurement | None:
        """Return the newest measurement, or None before the first."""
        ...

    def write(self, command: JointCommand) -> None:
        """Send a command."""
        ...

    def close(self) -> None:
        """End the connection; motors are left as the last command has them."""
        ...


class DescribedJoints:
    """The joints of export.json: gains, the default pose of the policy, and limits."""

    def __init__(self, meta: Export) -> None:
        joints: JointsSpec = meta["joints"]
        limits = joints["limits"]
        self.names = joints["names"]
        self.default_pos = _finite("default_pos", joints)
        self.stiffness = _finite("stiffness", joints, least=0.0)
        self.damping = _finite("damping", joints, least=0.0)
        self.effort_scale = _finite("effort_scale", joints)
        self.lowest = _or([low for low, _ in limits["position"]], -np.inf)
        self.highest = _or([high for _, high in limits["position"]], np.inf)
        self.most_effort = _or(limits["effort"], np.inf)
        self.most_speed = _or(limits["velocity"], np.inf)
        self._check_limits()
        asked = set(meta["joint_names"])
        driven = [name in asked for name in self.names]
        self.driven = np.array(driven, bool) | (self.stiffness > 0.0) | (self.damping > 0.0)

    def _check_limits(self) -> None:
        """Refuse limits between which nothing is: clipped to them, a command would push or drive a joint."""
        still = np.zeros(len(self.names))
        for what, low, high in (
            ("position", self.lowest, self.highest),
            ("effort", still, self.most_effort),
            ("velocity", still, self.most_speed),
        ):
            if low.shape != still.shape or high.shape != still.shape:
                raise ValueError(
                    f"export.json: joints.limits.{what}: expected an entry for each of {len(still)} joints"
                )
            for place in np.flatnonzero(low > high):
                raise ValueError(
                    f"export.json: joints.limits.{what} of {self.names[place]!r} is {high[place]:g}: expected "
                    f"{low[place]:g} or more"
                )

    def columns(self, names: list[str]) -> Array:
        """Return the places of some joints."""
        return np.array([self.names.index(name) for name in names], int)


class Control(Protocol):
    """The controller of the motors once the robot stands.

    `command` is what an operator may change; what is beyond its `ranges` is clipped. `pictures` describes the cameras
    that it sees by.
    """

    joints: DescribedJoints
    pictures: list[Json]
    command: dict[str, Array]
    ranges: dict[str, CommandRange]

    def begin(self) -> None:
        """Begin an episode."""
        ...

    def __call__(self, measurement: Measurement) -> JointCommand:
        """Return the command to the motors in this period."""
        ...


def _finite(
    what: Literal["default_pos", "stiffness", "damping", "effort_scale"],
    joints: JointsSpec,
    *,
    least: float = -np.inf,
) -> Array:
    """Return an entry of export.json, a number for each joint; a ValueError if one is not finite or below `least`."""
    numbers = np.array(joints[what], float)
    for name, number in zip(joints["names"], numbers, strict=True):
        if not np.isfinite(number) or number < least:
            raise ValueError(
                f"export.json: joints.{what} of {name!r} is {number:g}: expected {least:g} to inf"
            )
    return numbers


def _or(values: list[float | None], otherwise: float) -> Array:
    # JSON has no infinity: None is a side without a bound.
    numbers = np.array(values, float)
    return np.where(np.isnan(numbers), otherwise, numbers)


def to_root_axes(quat: Array, vector: Array) -> Array:
    """Return a vector of the world in the axes of a root whose attitude is `quat` (w, x, y, z), of length 1."""
    turned_back = quat * np.array([1.0, -1.0, -1.0, -1.0])
    return to_world_axes(turned_back, vector)


def to_world_axes(quat: Array, vector: Array) -> Array:
    """Return a vector of a root's axes in the axes of the world."""
    axis = quat[1:]
    twice = 2.0 * np.cross(axis, vector)
    return vector + quat[0] * twice + np.cross(axis, twice)


DOWN = np.array([0.0, 0.0, -1.0])
"""Gravity's direction in the world."""
