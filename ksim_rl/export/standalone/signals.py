"""Computes the values that an exported folder describes from MuJoCo's state."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from ksim_rl.export.standalone.contacts import Contacts
from ksim_rl.export.standalone.files import Array, Json, check_count, read_json, read_model

Value = Callable[[], Array]
# An export is a stranger's file: deeper nesting would exhaust Python's stack, more parts its memory.
MOST_DEPTH, MOST_NODES = 40, 100_000
INTEGRATORS = {
    name.removeprefix("mjINT_").lower(): kind for name, kind in mujoco.mjtIntegrator.__members__.items()
}
# Only these can be called from an export: names map to fixed functions, never to attributes of numpy.
FUNCTIONS: dict[str, Callable[..., Any]] = {
    name: getattr(np, name)
    for name in (
        *("add", "subtract", "multiply", "divide", "maximum", "minimum", "where"),
        *("negative", "absolute", "square", "sqrt", "exp", "log1p", "sin", "cos", "sign"),
    )
}
# Truth values are 0.0 and 1.0, so that they can be weighted and added like any other value.
FUNCTIONS |= {
    "greater": lambda a, b: (a > b) * 1.0,
    "less": lambda a, b: (a < b) * 1.0,
    "any": lambda a: np.atleast_1d(np.any(a > 0) * 1.0),
    "mean": lambda a: np.atleast_1d(a.mean()),
    "concat": lambda *parts: np.concatenate(parts),
    # The small bound keeps a zero vector finite.
    "normalize": lambda a: a / max(float(np.linalg.norm(a)), 1e-12),
    "subtract_point": lambda a, b: (a.reshape(-1, 3) - b).ravel(),
    "rotate": lambda quat, vector: rotated(quat, vector),
    # The conjugate of a unit quaternion is its inverse.
    "rotate_inverse": lambda quat, vector: rotated(quat * np.array([1.0, -1.0, -1.0, -1.0]), vector),
}


def _in_blocks(values: Array, width: int | None) -> Array:
    """Return values in rows of a width; without one they are a single row."""
    if width:
        return values.reshape(-1, width)
    return values[None]


def _sum(blocks: Array) -> Array:
    return blocks.sum(-1)


def _norm(blocks: Array) -> Array:
    return np.sqrt((blocks * blocks).sum(-1))


def rotated(quat: Array, vector: Array) -> Array:
    """Return a vector turned by a quaternion (w, x, y, z)."""
    result = np.zeros(3)
    # MuJoCo reads both as raw doubles in a row, and writes into `result`.
    mujoco.mju_rotVecQuat(
        result, np.ascontiguousarray(vector, np.float64), np.ascontiguousarray(quat, np.float64)
    )
    return result


class Lag:
    """A value as it was some steps ago; before an episode's first value lies that value, or `initial`."""

    def __init__(self, spec: Json, signals: "Signals") -> None:
        self.spec, self.signals = spec, signals
        self.most = check_count("steps of a delay", spec["max"])
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.kept, self.age = [], 0
        self.lag = self._draw()

    def _draw(self) -> int:
        # Those that share a lag draw it once.
        # The age is in the key, so a later draw of the same group is a new one.
        drawn, key = self.signals.drawn, (self.spec.get("shared") or id(self), self.age)
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
        self.kept = [value, *(self.kept or [first] * self.most)][: self.most + 1]
        return self.kept[self.lag]


class Noise:
    """A sensor's errors: bias, walk, noise, resolution, dropout, in this order."""

    def __init__(self, spec: Json, signals: "Signals") -> None:
        self.spec, self.signals, self.bias, self.walk, self.last = spec, signals, None, 0.0, None

    def _sample(self, spec: Json, size: int) -> Array:
        # Uniform draws lie in [0, 1), gaussian ones have std 1; offset and spread map them to the range.
        draws = self.signals.draws
        unit = {"uniform": draws.random, "gaussian": draws.standard_normal, "none": np.zeros}[spec["draw"]](
            size
        )
        return np.asarray(spec["offset"]) + np.asarray(spec["spread"]) * unit

    def reset(self) -> None:
        """Begin an episode."""
        self.bias, self.walk, self.last = None, 0.0, None

    def __call__(self, value: Array) -> Array:
        """Return the reading of a value."""
        # There is no last reading before the first one of an episode.
        spec, first = self.spec, self.last is None
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
            self.walk = self.walk + np.asarray(spec["walk_std"]) * self.signals.draws.standard_normal(
                len(value)
            )
        value, sample = value + self.walk, self._sample(spec, len(value))
        value = value * sample if spec["operation"] == "multiply" else value + sample
        # Round to the steps of the converter; where the resolution is 0 the value passes unchanged.
        grain = np.broadcast_to(spec["resolution"], value.shape)
        value = np.where(grain > 0, np.round(value / np.where(grain > 0, grain, 1.0)) * grain, value)
        # A lost reading repeats the last one or reads 0; the first has nothing to repeat.
        if not first and spec["dropout"] and self.signals.draws.random() < spec["dropout"]:
            if spec["lost"] == "last":
                value = np.asarray(self.last)
            else:
                value = np.zeros_like(value)
        self.last = value
        return value


class Signals:
    """The quantities of a robot's model, and the descriptions that are made of them."""

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
        self._nodes = 0
        # Addresses differ from joint numbers as soon as there is a free or ball joint.
        names = meta["joints"]["names"]
        self.joints = {n: (int(model.joint(n).qposadr[0]), int(model.joint(n).dofadr[0])) for n in names}
        # The model's own pose, and this episode's, which a recorded start may have drawn around it.
        self.own_default = dict(zip(names, meta["joints"]["default_pos"], strict=True))
        self.default = dict(self.own_default)
        # Errors of joint encoders, rad, which a recorded start may set.
        self.bias = dict.fromkeys(names, 0.0)
        # Commands are zero until the caller gives one.
        sizes = {n: check_count(f"commands.{n}.size", c["size"]) for n, c in meta["commands"].items()}
        self.command: dict[str, Array] = {name: np.zeros(size) for name, size in sizes.items()}
        self.contacts = {name: Contacts(spec, model) for name, spec in meta["contacts"].items()}
        self.action = self.last_action = np.zeros(
            check_count("policy.num_actions", meta["policy"]["num_actions"])
        )
        self.steps, self.terminated = 0, False
        # Height fields are the terrain; where there is none, the ground is the plane z = 0.
        self.ground = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_HFIELD]

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

    def refresh(self) -> None:
        """Recompute all that follows from position and velocity; contacts and forces stay from the last substep."""
        model, data = self.model, self.data
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            compute(model, data)
        mujoco.mj_sensorPos(model, data)
        mujoco.mj_sensorVel(model, data)

    def bias_of(self, names: list[str]) -> Array:
        """Return what the encoders of some joints read beyond their positions, rad or m."""
        return np.array([self.bias[name] for name in names])

    def value(self, node: Any, depth: int = 0) -> Value:
        """Return a function that computes a description; a ValueError shows a part that is not one."""
        # Parts are counted over all descriptions of the export, not for each one.
        self._nodes += 1
        if depth > MOST_DEPTH or self._nodes > MOST_NODES:
            raise ValueError("export.json: a description has too many parts")
        if not isinstance(node, dict):
            constant = np.atleast_1d(np.asarray(node, np.float64))
            return lambda: constant
        try:
            if "quantity" in node:
                return self._quantity(node["quantity"], node)
            return self._op(node["op"], node, [self.value(part, depth + 1) for part in node["of"]])
        # A description is data of a stranger: a missing key or a wrong type is told with its text.
        except (KeyError, TypeError) as error:
            raise ValueError(f"export.json: {str(node)[:200]}: {error}") from None

    def _op(self, name: str, node: Json, parts: list[Value]) -> Value:
        # Values are flat; `width` says how many numbers belong to one item, such as 3 for a vector.
        width = node.get("width")
        if name in ("sum", "norm"):
            power = _norm if name == "norm" else _sum
            return lambda: power(_in_blocks(parts[0](), width))
        if name == "take":
            wanted = np.asarray(node["indices"], int)
            return lambda: _in_blocks(parts[0](), width)[:, wanted].ravel()
        if name == "clip":
            return lambda: np.clip(parts[0](), node["low"], node["high"])
        # Rows times the matrix is the transpose's product: from world axes into the body's.
        if name == "into":
            body = self.model.body(node["body"]).id
            return lambda: (parts[0]().reshape(-1, 3) @ self.data.xmat[body].reshape(3, 3)).ravel()
        # These keep a value from step to step, and so have to forget it at a reset.
        if name in ("previous", "peak", "low_pass"):
            return self._remembering(name, node, parts)
        function = FUNCTIONS[name]

        def applied() -> Array:
            return function(*[part() for part in parts])

        return applied

    def _remembering(self, name: str, node: Json, parts: list[Value]) -> Value:
        # None until the first call of an episode.
        kept: list[Any] = [None]
        self.resets.append(lambda: kept.__setitem__(0, None))

        def previous() -> Array:
            value = parts[0]()
            before, kept[0] = np.zeros_like(value) if kept[0] is None else kept[0], value
            return before

        def peak() -> Array:
            # Height of the swing so far; a landing gives the peak once and starts again at 0.
            height, found, landed = (part() for part in parts)
            before = np.zeros_like(height) if kept[0] is None else kept[0]
            highest = np.where(found > 0, before, np.maximum(before, height))
            kept[0] = np.where(landed > 0, 0.0, highest)
            return highest

        def low_pass() -> Array:
            # Exact for a first-order filter at any step length.
            gain = 1.0 - math.exp(-self.step_dt / node["time_constant"])
            if kept[0] is None:
                kept[0] = parts[0]()
            else:
                kept[0] = kept[0] + gain * (parts[0]() - kept[0])
            return kept[0]

        return {"previous": previous, "peak": peak, "low_pass": low_pass}[name]

    def _quantity(self, name: str, node: Json) -> Value:
        data, model = self.data, self.model
        # Readings of joints, rad and rad/s (m and m/s for slides), in the order of the names.
        if "joints" in node:
            names = node["joints"]
            pos = np.array([self.joints[joint][0] for joint in names], int)
            vel = np.array([self.joints[joint][1] for joint in names], int)
            # Only measured angles have encoder errors; rewards read true ones.
            biased = bool(node.get("biased"))
            of_joints = {
                "joint_pos": lambda: data.qpos[pos] + (self.bias_of(names) if biased else 0.0),
                "joint_vel": lambda: data.qvel[vel],
                "joint_acc": lambda: data.qacc[vel],
                "joint_effort": lambda: data.qfrc_actuator[vel],
            }
            if name == "joint_pos_rel":

                def joint_pos_rel() -> Array:
                    # Looked up at each reading, since a recorded start may bring another default pose.
                    default = [self.default[joint] for joint in names]
                    return of_joints["joint_pos"]() - default

                return joint_pos_rel
            return of_joints[name]
        # Bodies and sites, in the world frame. `data` is the same object for good, so its arrays may be kept.
        if "bodies" in node or "sites" in node:
            if "bodies" in node:
                kind = "body"
                where = data.xpos
                ids = [model.body(name).id for name in node["bodies"]]
            else:
                kind = "site"
                where = data.site_xpos
                ids = [model.site(name).id for name in node["sites"]]
            if name == "site_lin_vel_of_contacts":
                return self._kept_velocities(ids)
            return {
                f"{kind}_pos": lambda: where[ids].ravel(),
                # Above the ground below each point, not above z = 0.
                f"{kind}_height": lambda: where[ids][:, 2] - [self.ground_at(p) for p in where[ids]],
                # mj_objectVelocity gives angular velocity first, linear second.
                f"{kind}_lin_vel": lambda: self._velocities(kind, ids)[:, 3:].ravel(),
                f"{kind}_ang_vel": lambda: self._velocities(kind, ids)[:, :3].ravel(),
                "body_quat": lambda: data.xquat[ids].ravel(),
                # The first two axes of each body: six numbers fix an orientation without jumps.
                "body_axes": lambda: data.xmat[ids].reshape(-1, 3, 3).transpose(0, 2, 1)[:, :2].ravel(),
                "com_pos": lambda: data.subtree_com[ids].ravel(),
            }[name]
        # The root, in its own axes where the frame says so.
        if "body" in node:
            body, local = model.body(node["body"]).id, node.get("frame") == "root"
            return {
                # Gravity's direction (0, 0, -1) in the body's axes is the matrix's last row, negated.
                "projected_gravity": lambda: -data.xmat[body].reshape(3, 3)[2],
                "root_lin_vel": lambda: self._velocities("body", [body], local)[0, 3:],
                "root_ang_vel": lambda: self._velocities("body", [body], local)[0, :3],
                "height_scan": lambda: self._scan(body, np.asarray(node["points"])),
            }[name]
        # A sensor of the model, any width.
        if name == "sensor":
            start = int(model.sensor(node["sensor"]).adr[0])
            stop = start + int(model.sensor(node["sensor"]).dim[0])
            # A copy: the array would change under a lag that keeps it.
            return lambda: data.sensordata[start:stop].copy()
        if name == "contact":
            tracker, field = self.contacts[node["sensor"]], node["field"]
            return lambda: tracker.fields[field]
        if name == "command":
            return lambda: self.command[node["command"]]
        if name == "actuator_force":
            actuators = [model.actuator(n).id for n in node["actuators"]]
            return lambda: data.actuator_force[actuators]
        return {
            "action": lambda: self.action,
            "last_action": lambda: self.last_action,
            "terminated": lambda: np.array([float(self.terminated)]),
            "time": lambda: np.array([self.steps * self.step_dt]),
            "time_left": lambda: np.array([max(self.limit - self.steps, 0) * self.step_dt]),
        }[name]

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
        axis, origin = self.data.xmat[body].reshape(3, 3)[:, 0], self.data.xpos[body]
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
            near = np.clip(point[:2] - self.data.geom_xpos[geom][:2], -size[:2] + 1e-6, size[:2] - 1e-6)
            above = np.append(near + self.data.geom_xpos[geom][:2], 1e3)
            # Down from 1 km above all terrain; a miss returns a negative distance.
            distance = mujoco.mj_rayHfield(self.model, self.data, geom, above, np.array([0.0, 0.0, -1.0]))
            heights += [1e3 - distance] * (distance >= 0)
        return max(heights, default=0.0)
