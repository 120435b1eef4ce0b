"""Runs an exported policy on a robot's measurements: measurement to observation, to action, to joint targets."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ksim_rl.export.standalone.commands import command_ranges
from ksim_rl.export.standalone.description import Export, JointActionSpec
from ksim_rl.export.standalone.files import (
    Array,
    Json,
    check_count,
    check_seconds,
    measurements,
    refusing,
)
from ksim_rl.export.standalone.network import Network, Policy
from ksim_rl.export.standalone.robot_link import (
    DOWN,
    DescribedJoints,
    JointCommand,
    Measurement,
    to_root_axes,
    to_world_axes,
)
from ksim_rl.export.standalone.stages import JointAction, Stage, clipped_and_scaled, stage

Reading = Callable[[Measurement], Array]
# What follows from joints, from the attitude, and from what the loop itself did.
OF_JOINTS = ("joint_pos", "joint_pos_rel", "joint_vel", "joint_effort")
OF_TARGETS = {"joint_pos_target": "pos", "joint_vel_target": "vel", "joint_effort_target": "effort"}
OF_ROOT = ("root_quat", "projected_gravity", "root_ang_vel")


class PolicyControl:
    """An exported policy, its observations and its actions, for one robot."""

    def __init__(self, folder: Path, meta: Export) -> None:
        with refusing(folder):
            self._read(folder, meta)
            self.begin()

    def _read(self, folder: Path, meta: Export) -> None:
        actions: list[JointActionSpec] = []
        for action in meta["actions"]:
            if action["kind"] == "ctrl":
                raise ValueError(
                    f"export.json: the action {action['name']!r} writes controls of a model's actuators, which a robot "
                    "does not have: train with actions of joints"
                )
            actions.append(action)
        self.meta = meta
        self.step_dt = check_seconds("export.json: step_dt", meta["step_dt"])
        self.num_actions = check_count("policy.num_actions", meta["policy"]["num_actions"])
        self.joints = DescribedJoints(meta)
        self.observe: Network | None = None
        if meta["obs"] is not None:
            obs = meta["obs"]
            self.observe = Network(folder / "obs.onnx", obs["states"], obs["output"])
        self.pictures: list[Json] = meta.get("pictures", [])
        self.policy = Policy(folder, meta)
        self.ranges = command_ranges(meta)
        self.command: dict[str, Array] = {}
        for name, allowed in self.ranges.items():
            self.command[name] = np.zeros(allowed.size)
        self.estimated: list[str] = []
        self.of_root: set[str] = set()
        self.sources: dict[str, Reading] = {}
        for node in measurements(meta):
            self.sources[node["input"]] = self._source(node)
        self.terms = [clipped_and_scaled(spec) for spec in meta["observations"]]
        self.stops = np.cumsum([spec["size"] for spec in meta["observations"]])
        self.resets: list[Callable[[], None]] = []
        # Delays are of the training: a robot has lags of its own.
        self.chain: list[Stage] = []
        for spec in meta["action_chain"]:
            if spec["kind"] != "delay":
                self.chain.append(stage(spec, self.resets))
        self.actions = [JointAction(spec, self.resets) for spec in actions]
        self.places = [self.joints.columns(action.names) for action in self.actions]

    def begin(self) -> None:
        """Begin an episode: forget states, actions and time; commands stay."""
        self.steps = 0
        self.action = np.zeros(self.num_actions)
        self.last_action = self.action
        still = np.zeros(len(self.joints.names))
        self.targets = {"pos": self.joints.default_pos.copy(), "vel": still, "effort": still}
        if self.observe is not None:
            self.observe.reset()
        self.policy.reset()
        for forget in self.resets:
            forget()

    def lacking(self, measurement: Measurement) -> list[str]:
        """Return the inputs of `obs.onnx` that a robot's measurements do not give."""
        found = [name for name in self.estimated if name not in measurement.estimates]
        for spec in self.pictures:
            if spec["input"] not in measurement.pictures:
                found.append(spec["input"])
        return found + [name for name in sorted(self.of_root) if getattr(measurement, name) is None]

    def __call__(self, measurement: Measurement) -> JointCommand:
        """Run one step of the policy, and return its targets for the motors."""
        action = self.policy(self._frame(measurement), self._pictures(measurement))
        for change in self.chain:
            action = change(action)
        self.last_action = self.action
        self.action = action
        targets = {}
        for kind, values in self.targets.items():
            targets[kind] = values.copy()
        # The model's own pose: robots have no other.
        for asked, places in zip(self.actions, self.places, strict=True):
            encoders = measurement.joint_pos[places]
            for kind, values in asked(action, encoders, np.zeros(len(places))).items():
                targets[kind][places] = values
        self.targets = targets
        self.steps += 1
        return JointCommand(
            pos=targets["pos"],
            vel=targets["vel"],
            # What a target of effort is in the model, a motor exerts at its joint.
            effort=self.joints.effort_scale * targets["effort"],
            stiffness=self.joints.stiffness,
            damping=self.joints.damping,
        )

    def _frame(self, measurement: Measurement) -> Array:
        """Return the numbers that the policy reads."""
        if self.observe is None:
            return np.zeros(0)
        given = {}
        for name, source in self.sources.items():
            given[name] = source(measurement)
        raw = np.split(self.observe.run(given), self.stops[:-1])
        self.observe.advance()
        frame = [term(part) for term, part in zip(self.terms, raw, strict=True)]
        return np.concatenate(frame)

    def _pictures(self, measurement: Measurement) -> dict[str, Array]:
        """Return the pictures that the policy reads; a ValueError names one that is not as its camera gives it."""
        found = {}
        for spec in self.pictures:
            name = spec["input"]
            picture = np.asarray(measurement.pictures[name])
            if list(picture.shape) != spec["shape"] or picture.dtype != spec["dtype"]:
                raise ValueError(
                    f"{name} is {picture.dtype} {list(picture.shape)}: expected {spec['dtype']} {spec['shape']}"
                )
            if spec["dtype"] == "float32":
                if not np.isfinite(picture).all():
                    raise ValueError(f"{name} holds numbers that are not finite")
                # As in training, where nothing is farther.
                picture = np.minimum(picture, np.float32(spec["max_depth"]))
            found[name] = picture
        return found

    def _source(self, node: Json) -> Reading:
        """Return the value of an input of `obs.onnx`: the loop's own number, or else an estimate of the robot."""
        quantity = node["quantity"]
        if quantity in OF_TARGETS:
            kind = OF_TARGETS[quantity]
            columns = self.joints.columns(node["joints"])
            return lambda _: self.targets[kind][columns]
        if quantity in OF_JOINTS:
            return self._of_joints(quantity, self.joints.columns(node["joints"]))
        if quantity in OF_ROOT:
            return self._of_root(quantity, node.get("frame", "root"))
        if quantity == "command":
            name = node["command"]
            # Whatever a stick says, the policy reads only commands that it has seen.
            return lambda _: self.ranges[name].clip(self.command[name])
        if quantity == "default_joint_pos":
            default = self.joints.default_pos[self.joints.columns(node["joints"])]
            return lambda _: default
        if quantity == "encoder_bias":
            # Readings of a robot have it in them.
            zeros = np.zeros(len(node["joints"]))
            return lambda _: zeros
        of_the_loop: dict[str, Reading] = {
            "action": lambda _: self.action,
            "last_action": lambda _: self.last_action,
            "terminated": lambda _: np.array([False]),
            "step": lambda _: np.array([self.steps]),
            "time_out_offset": lambda _: np.zeros(1),
            "time": lambda _: np.array([self.steps * self.step_dt]),
        }
        if quantity in of_the_loop:
            return of_the_loop[quantity]
        name = node["input"]
        self.estimated.append(name)
        return lambda measurement: measurement.estimates[name]

    def _of_joints(self, quantity: str, columns: Array) -> Reading:
        default = self.joints.default_pos[columns]
        readings: dict[str, Reading] = {
            "joint_pos": lambda measured: measured.joint_pos[columns],
            "joint_pos_rel": lambda measured: measured.joint_pos[columns] - default,
            "joint_vel": lambda measured: measured.joint_vel[columns],
            "joint_effort": lambda measured: measured.joint_effort[columns],
        }
        return readings[quantity]

    def _of_root(self, quantity: str, frame: str) -> Reading:
        if quantity == "root_ang_vel":
            self.of_root.add("root_ang_vel")
        # What is in the axes of the world needs the attitude, too.
        if quantity != "root_ang_vel" or frame != "root":
            self.of_root.add("root_quat")

        def quat(measured: Measurement) -> Array:
            assert measured.root_quat is not None  # `lacking` was asked
            return measured.root_quat

        def ang_vel(measured: Measurement) -> Array:
            assert measured.root_ang_vel is not None  # `lacking` was asked
            if frame == "root":
                return measured.root_ang_vel
            return to_world_axes(quat(measured), measured.root_ang_vel)

        readings: dict[str, Reading] = {
            "root_quat": quat,
            "projected_gravity": lambda measured: to_root_axes(quat(measured), DOWN),
            "root_ang_vel": ang_vel,
        }
        return readings[quantity]
