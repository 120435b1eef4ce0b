"""Reads the quantities of an exported folder from MuJoCo's state, and makes its values of them by ONNX files."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from ksim_rl.export.standalone.commands import command_ranges
from ksim_rl.export.standalone.contacts import Contacts
from ksim_rl.export.standalone.description import LagSpec, NoiseSpec
from ksim_rl.export.standalone.files import Array, Json, check_count, read_json
from ksim_rl.export.standalone.models import read_model
from ksim_rl.export.standalone.network import Network

Value = Callable[[], Array]
# In this order targets lie side by side in a trace: rad (m for slides), rad/s, N m.
KINDS = ("pos", "vel", "effort")
INTEGRATORS = {
    name.removeprefix("mjINT_").lower(): kind
    for name, kind in mujoco.mjtIntegrator.__members__.items()
}
# Arrays of MuJoCo's data that an exported model has in the env's layout, and the only ones that an export may name.
ARRAYS = (
    *("qpos", "qvel", "qacc", "qfrc_actuator", "sensordata", "cvel", "subtree_com"),
    *("xpos", "xquat", "xmat", "xipos", "site_xpos", "site_xmat", "geom_xpos", "geom_xmat"),
)


class Lag:
    """A value as it was some steps ago; before an episode's first value lies that value, or `initial`."""

    def __init__(self, spec: LagSpec, signals: "Signals") -> None:
        self.spec = spec
        self.signals = signals
        self.most = check_count("steps of a delay", spec["max"])
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.kept = []
        self.age = 0
        self.lag = self._draw()

    def _draw(self) -> int:
        # Those that share a lag draw it once.
        # The age is in the key, so a later draw of the same group is a new one.
        drawn = self.signals.drawn
        key = (self.spec.get("shared") or id(self), self.age)
        if key not in drawn:
            drawn[key] = int(self.signals.draws.integers(self.spec["min"], self.most + 1))
            # Not at the first draw: there is no earlier lag to hold.
            if self.age and self.signals.draws.random() < self.spec["hold_probability"]:
                drawn[key] = self.lag
        return drawn[key]

    def __call__(self, value: Array, advances: bool = True) -> Array:
        """Return the value that arrives now, as `value` sets out."""
        self.age += advances
        # 0 keeps an episode's lag to its end.
        every = self.spec["resample_every"]
        if advances and every and self.age % every == 0:
            self.lag = self._draw()
        if self.spec["initial"] is None:
            first = value
        else:
            first = np.full_like(value, self.spec["initial"])
        # Newest first. The list is filled up at the first call, so that every lag finds a value.
        before = self.kept or [first] * self.most
        self.kept = [value, *before][: self.most + 1]
        return self.kept[self.lag]


class Noise:
    """A sensor's errors: bias, walk, noise, resolution, dropout, in this order."""

    def __init__(self, spec: NoiseSpec, signals: "Signals") -> None:
        self.spec = spec
        self.signals = signals
        self.bias = None
        self.walk = 0.0
        self.last = None

    def _sample(self, spec: NoiseSpec, size: int) -> Array:
        # Uniform draws lie in [0, 1), gaussian ones have std 1; offset and spread map them to the range.
        draws = self.signals.draws
        unit = {"uniform": draws.random, "gaussian": draws.standard_normal, "none": np.zeros}[
            spec["draw"]
        ](size)
        return np.asarray(spec["offset"]) + np.asarray(spec["spread"]) * unit

    def reset(self) -> None:
        """Begin an episode."""
        self.bias = None
        self.walk = 0.0
        self.last = None

    def __call__(self, value: Array) -> Array:
        """Return the reading of a value."""
        # There is no last reading before the first one of an episode.
        spec = self.spec
        first = self.last is None
        # A constant error of the episode, such as of calibration: drawn once, then kept.
        if spec["bias"]:
            if self.bias is None:
                self.bias = self._sample(spec["bias"], len(value))
            if spec["bias"]["operation"] == "multiply":
                value = value * self.bias
            else:
                value = value + self.bias
        # A random walk: it begins at 0 and grows by one draw per reading.
        if not first:
            self.walk = self.walk + np.asarray(
                spec["walk_std"]
            ) * self.signals.draws.standard_normal(len(value))
        value = value + self.walk
        sample = self._sample(spec, len(value))
        if spec["operation"] == "multiply":
            value = value * sample
        else:
            value = value + sample
        # Round to the steps of the converter; where the resolution is 0 the value passes unchanged.
        grain = np.broadcast_to(spec["resolution"], value.shape)
        value = np.where(
            grain > 0, np.round(value / np.where(grain > 0, grain, 1.0)) * grain, value
        )
        # A lost reading repeats the last one or reads 0; the first has nothing to repeat.
        if not first and spec["dropout"] and self.signals.draws.random() < spec["dropout"]:
            if spec["lost"] == "last":
                value = np.asarray(self.last)
            else:
                value = np.zeros_like(value)
        self.last = value
        return value


class Values:
    """Computes one ONNX file's outputs from the quantities that it reads."""

    def __init__(self, signals: "Signals", name: Literal["obs", "scores"]) -> None:
        spec = signals.meta[name]
        # A task without rewards, metrics and terminations has none, nor has a policy that only sees.
        self.network = None
        self.read = {}
        if spec is not None:
            self.network = Network(signals.folder / f"{name}.onnx", spec["states"], spec["output"])
            self.read = {one["input"]: signals.quantity(one) for one in spec["measurements"]}

    def __call__(self) -> Array:
        """Return the values of the current state; ask once per env step, or `advance` afterwards."""
        if self.network is None:
            return np.zeros(0)
        return self.network.run({name: read() for name, read in self.read.items()})

    def named(self, names: list[tuple[str, str]]) -> dict[tuple[str, str], float]:
        """Return the values of the current state by name, one each."""
        return dict(zip(names, self().tolist(), strict=True))

    def advance(self) -> None:
        """Let the step end, see `Network.advance`."""
        if self.network is not None:
            self.network.advance()

    def reset(self) -> None:
        """Begin an episode."""
        if self.network is not None:
            self.network.reset()


class Signals:
    """The quantities of a robot's model."""

    def __init__(self, folder: str | Path, seed: int = 0) -> None:
        self.folder = Path(folder)
        self.meta = meta = read_json(self.folder / "export.json")
        self.model = model = read_model(self.folder)
        self.data = mujoco.MjData(model)
        self.draws = np.random.default_rng(seed)
        self.decimation = check_count("decimation", meta["decimation"])
        # First everything that is counted: a wrong number is refused before arrays of that size exist.
        self.limit = check_count("episode_steps", meta["episode_steps"])
        # Filled by values that keep memory; `reset` calls them all.
        self.resets: list[Callable[[], None]] = []
        # Values of the moment of the contacts keep it here, between the last substep and the refresh.
        self.of_contacts: list[Callable[[], None]] = []
        # Shared lags of this episode by group and age, see `Lag`.
        self.drawn: dict[Any, int] = {}
        # Positions, velocities and efforts that joints are asked for; the runner's actions write them.
        self.targets = {kind: dict.fromkeys(meta["joints"]["names"], 0.0) for kind in KINDS}
        # Addresses differ from joint numbers as soon as there is a free or ball joint.
        names = meta["joints"]["names"]
        self.joints = {
            n: (int(model.joint(n).qposadr[0]), int(model.joint(n).dofadr[0])) for n in names
        }
        # The model's own pose, and this episode's, which a recorded start may have drawn around it.
        self.own_default = dict(zip(names, meta["joints"]["default_pos"], strict=True))
        self.default = dict(self.own_default)
        # Errors of joint encoders, rad, which a recorded start may set.
        self.bias = dict.fromkeys(names, 0.0)
        # Until the caller gives one: zero, or what is nearest to it among what the policy has seen.
        self.ranges = command_ranges(meta)
        self.command: dict[str, Array] = {}
        for name, allowed in self.ranges.items():
            self.command[name] = allowed.clip(np.zeros(allowed.size))
        self.contacts = {
            name: Contacts(spec, model, self.decimation) for name, spec in meta["contacts"].items()
        }
        self.action = self.last_action = np.zeros(
            check_count("policy.num_actions", meta["policy"]["num_actions"])
        )
        self.steps = 0
        self.terminated = False
        # Height fields are the terrain; where there is none, the ground is the plane z = 0.
        self.ground = [
            g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_HFIELD
        ]

    @property
    def step_dt(self) -> float:
        """Seconds of one env step."""
        return self.model.opt.timestep * self.decimation

    def change_physics(self, integrator: str, refine: int) -> None:
        """Integrate by another of MuJoCo's integrators, "" for the model's own, in `refine` times as many substeps."""
        # The length of an env step stays the same: the policy's rate is part of what it learned.
        option = self.model.opt
        if integrator:
            option.integrator = int(INTEGRATORS[integrator])
        option.timestep /= refine
        self.decimation *= refine
        for tracker in self.contacts.values():
            tracker.refine = refine

    def refresh(self) -> None:
        """Recompute all that follows from position and velocity; contacts and forces stay from the last substep."""
        model = self.model
        data = self.data
        # Velocities of subtrees, too: sensors of momentum read the last substep's where they are not computed.
        # Cameras and lights of pictures move with their bodies.
        stages = (
            mujoco.mj_kinematics,
            mujoco.mj_comPos,
            mujoco.mj_camlight,
            mujoco.mj_comVel,
            mujoco.mj_subtreeVel,
        )
        for compute in stages:
            compute(model, data)
        mujoco.mj_sensorPos(model, data)
        mujoco.mj_sensorVel(model, data)

    def bias_of(self, names: list[str]) -> Array:
        """Return the bias of the encoders of some joints, rad or m."""
        return np.array([self.bias[name] for name in names])

    def quantity(self, node: Json) -> Value:
        """Return a function that reads a quantity; a ValueError shows a node that names none."""
        try:
            return self._quantity(node["quantity"], node)
        # A node is untrusted data: the error for a missing key or a wrong type has its text.
        except (KeyError, TypeError) as error:
            raise ValueError(f"export.json: {str(node)[:200]}: {error}") from None

    def _quantity(self, name: str, node: Json) -> Value:
        for kind, read in (
            ("joints", self._of_joints),
            ("bodies", self._of_bodies),
            ("sites", self._of_sites),
            ("body", self._of_root),
        ):
            if kind in node:
                return read(name, node)
        data = self.data
        model = self.model
        # A sensor of the model, any width.
        if name == "sensor":
            start = int(model.sensor(node["sensor"]).adr[0])
            stop = start + int(model.sensor(node["sensor"]).dim[0])
            # A copy: the array would change under a lag that keeps it.
            return lambda: data.sensordata[start:stop].copy()
        if name == "contact":
            tracker = self.contacts[node["sensor"]]
            field = node["field"]
            tracker.fields[field]  # refused now, not in the first step
            return lambda: tracker.fields[field]
        if name == "command":
            self.command[node["command"]]
            return lambda: self.command[node["command"]]
        if name in ("actuator_force", "ctrl"):
            actuators = [model.actuator(n).id for n in node["actuators"]]
            array = {"actuator_force": data.actuator_force, "ctrl": data.ctrl}[name]
            return lambda: array[actuators]
        if name == "data":
            field = node["field"]
            if field not in ARRAYS:
                raise KeyError(field)
            return lambda: getattr(data, field)
        return {
            "action": lambda: self.action,
            "last_action": lambda: self.last_action,
            "terminated": lambda: np.array([self.terminated]),
            "step": lambda: np.array([self.steps]),
            # Only in training do first episodes end early, so that not all of them end at once.
            "time_out_offset": lambda: np.zeros(1),
            "time": lambda: np.array([self.steps * self.step_dt]),
        }[name]

    def _of_joints(self, name: str, node: Json) -> Value:
        """Readings of joints, rad and rad/s (m and m/s for slides), in the order of the names."""
        data = self.data
        names = node["joints"]
        pos = np.array([self.joints[joint][0] for joint in names], int)
        vel = np.array([self.joints[joint][1] for joint in names], int)

        def default() -> Array:
            # Looked up at each reading, since a recorded start may bring another default pose.
            return np.array([self.default[joint] for joint in names])

        def target(kind: str) -> Value:
            def asked() -> Array:
                return np.array([self.targets[kind][joint] for joint in names])

            return asked

        return {
            "joint_pos": lambda: data.qpos[pos],
            "joint_pos_rel": lambda: data.qpos[pos] - default(),
            "joint_vel": lambda: data.qvel[vel],
            "joint_acc": lambda: data.qacc[vel],
            "joint_effort": lambda: data.qfrc_actuator[vel],
            "default_joint_pos": default,
            # Of a simulated encoder; a robot's own reading has its bias in it.
            "encoder_bias": lambda: self.bias_of(names),
            "joint_pos_target": target("pos"),
            "joint_vel_target": target("vel"),
            "joint_effort_target": target("effort"),
        }[name]

    def _of_bodies(self, name: str, node: Json) -> Value:
        # `data` stays the same object, so its arrays may be kept.
        data = self.data
        ids = [self.model.body(body).id for body in node["bodies"]]
        return {
            "body_pos": lambda: data.xpos[ids],
            "body_quat": lambda: data.xquat[ids],
            # The axes are the columns of MuJoCo's matrix.
            "body_axes": lambda: data.xmat[ids].reshape(-1, 3, 3).transpose(0, 2, 1),
            # mj_objectVelocity gives angular velocity first, linear second.
            "body_lin_vel": lambda: self._velocities("body", ids)[:, 3:],
            "body_ang_vel": lambda: self._velocities("body", ids)[:, :3],
            "com_pos": lambda: data.subtree_com[ids],
        }[name]

    def _of_sites(self, name: str, node: Json) -> Value:
        data = self.data
        ids = [self.model.site(site).id for site in node["sites"]]
        if name == "site_lin_vel_of_contacts":
            return self._kept_velocities(ids)
        return {
            "site_pos": lambda: data.site_xpos[ids],
            "site_axes": lambda: data.site_xmat[ids].reshape(-1, 3, 3).transpose(0, 2, 1),
            # Above the ground below each point, not above z = 0.
            "site_height": lambda: self._heights(data.site_xpos[ids]),
            "site_lin_vel": lambda: self._velocities("site", ids)[:, 3:],
        }[name]

    def _of_root(self, name: str, node: Json) -> Value:
        """The root, in its own axes where the frame says so."""
        data = self.data
        body = self.model.body(node["body"]).id
        local = node.get("frame") == "root"
        return {
            "root_pos": lambda: data.xpos[body],
            "root_quat": lambda: data.xquat[body],
            "root_height": lambda: self._heights(data.xpos[[body]]),
            # Gravity's direction (0, 0, -1) in the body's axes is the matrix's last row, negated.
            "projected_gravity": lambda: -data.xmat[body].reshape(3, 3)[2],
            "root_lin_vel": lambda: self._velocities("body", [body], local)[0, 3:],
            "root_ang_vel": lambda: self._velocities("body", [body], local)[0, :3],
            "ground_below": lambda: self._scan(body, np.asarray(node["points"])),
        }[name]

    def _heights(self, points: Array) -> Array:
        """Return how high points [N, 3] are above the ground right below them."""
        return points[:, 2] - [self.ground_at(point) for point in points]

    def _kept_velocities(self, ids: list[int]) -> Value:
        """Return a function that gives the velocities of sites at the start of the last substep, 0 after a reset."""
        kept = np.zeros(3 * len(ids))

        def keep() -> None:
            # mj_step integrates last, and leaves the velocities of frames as they were before.
            kept[:] = self._velocities("site", ids)[:, 3:].ravel()

        self.of_contacts.append(keep)
        self.resets.append(lambda: kept.fill(0.0))
        return lambda: kept

    def _velocities(self, kind: str, ids: list[int], local: bool = False) -> Array:
        """Return angular, then linear velocity of the frames of bodies or sites, [N, 6]."""
        # mjOBJ_XBODY is the body's own frame; mjOBJ_BODY would be the frame of its inertia.
        if kind == "body":
            of_kind = mujoco.mjtObj.mjOBJ_XBODY
        else:
            of_kind = mujoco.mjtObj.mjOBJ_SITE
        found = np.zeros((len(ids), 6))
        for row, number in zip(found, ids, strict=True):
            mujoco.mj_objectVelocity(self.model, self.data, of_kind, number, row, local)
        return found

    def _scan(self, body: int, points: Array) -> Array:
        """Return how far the ground is below a body at points [N, 2] that turn with its yaw."""
        # The scan turns with yaw only: pitch and roll of the body leave its points in place.
        axis = self.data.xmat[body].reshape(3, 3)[:, 0]
        origin = self.data.xpos[body]
        yaw = math.atan2(axis[1], axis[0])
        turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        # The inverse rotation, since points are rows that multiply from the left.
        return origin[2] - np.array([self.ground_at(p) for p in origin[:2] + points @ turn])

    def ground_at(self, point: Array) -> float:
        """Return the terrain's height below a point: 0 on a plane; beyond an edge, the nearest point's height."""
        # Without a height field the list has the plane's 0; with one it has only the fields' own heights.
        heights = [0.0] * (not self.ground)
        for geom in self.ground:
            size = self.model.hfield_size[self.model.geom_dataid[geom]]
            # Just inside of the field: a ray on its edge misses it.
            near = np.clip(
                point[:2] - self.data.geom_xpos[geom][:2], -size[:2] + 1e-6, size[:2] - 1e-6
            )
            above = np.append(near + self.data.geom_xpos[geom][:2], 1e3)
            # Down from 1 km above all terrain; a miss returns a negative distance.
            distance = mujoco.mj_rayHfield(
                self.model, self.data, geom, above, np.array([0.0, 0.0, -1.0])
            )
            heights += [1e3 - distance] * (distance >= 0)
        return max(heights, default=0.0)
