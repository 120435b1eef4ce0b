"""The loop of an exported policy, its commands and pushes in its robot's model on MuJoCo's C engine."""

from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import numpy as np

from ksim_rl.export.standalone.description import ActionSpec, LawSpec, StageSpec, TermSpec
from ksim_rl.export.standalone.files import Array, Json
from ksim_rl.export.standalone.network import Policy
from ksim_rl.export.standalone.sight import Sight
from ksim_rl.export.standalone.signals import KINDS, Lag, Noise, Signals, Values
from ksim_rl.export.standalone.stages import (
    JointAction,
    clipped_and_scaled,
    shaping,
    stage,
)

# Fields of MjData that a recording may set.
STATE = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat")


class Runner(Signals):
    """An exported policy in its robot's model."""

    def __init__(self, folder: str | Path, seed: int = 0) -> None:
        super().__init__(folder, seed)
        meta = self.meta
        self.policy = Policy(self.folder, meta)
        self.noisy = bool(meta.get("noisy", True))
        self.lags: list[Lag] = []
        self.noises: list[Noise] = []
        self.readings = Values(self, "obs")
        self.scores = Values(self, "scores")
        self.sight = Sight(self)
        self.terms = [self._term(spec) for spec in meta["observations"]]
        self.stops = np.cumsum([spec["size"] for spec in meta["observations"]])
        kinds = ("terminations", "rewards", "metrics")
        self.scored = [(kind, name) for kind in kinds for name in meta[kind]]
        self.chain = [self._stage(spec) for spec in meta["action_chain"]]
        self.asked = [self._action(spec) for spec in meta["actions"]]
        self.laws = [self._law(spec) for spec in meta["actuators"]]
        self.reset()

    # -- observations --------------------------------------------------------------------------------------------

    def _term(self, spec: TermSpec) -> Callable[[Array, bool], Array]:
        shaped = clipped_and_scaled(spec)
        lag = None
        noise = Noise(spec["noise"], self) if spec["noise"] else None
        self.noises += [noise] if noise else []
        if spec["delay"]:
            lag = Lag(spec["delay"], self)
            self.lags.append(lag)

        def term(value: Array, advances: bool) -> Array:
            # As in training: noise on the raw value, then clip, scale and delay.
            if noise and self.noisy:
                value = noise(value)
            value = shaped(value)
            return value if lag is None else lag(value, advances)

        return term

    def observe(self, advances: bool = True) -> Array:
        """Return the newest frame that the policy reads, [L]; call it once per env step, as pictures are drawn then."""
        self.pictures = self.sight(advances)
        if not self.terms:
            return np.zeros(0)
        parts = np.split(self.readings(), self.stops[:-1])
        self.readings.advance()
        frame = [term(part, advances) for term, part in zip(self.terms, parts, strict=True)]
        return np.concatenate(frame)

    # -- actions and actuators -----------------------------------------------------------------------------------

    def _stage(self, spec: StageSpec) -> Callable[[Array], Array]:
        if spec["kind"] == "delay":
            lag = Lag(spec, self)
            self.lags.append(lag)
            return lag
        return stage(spec, self.resets)

    def _action(self, spec: ActionSpec) -> Callable[[Array], None]:
        # The model's own actuator, driven without a law in between.
        if spec["kind"] == "ctrl":
            columns = slice(*spec["columns"])
            shape = shaping(spec, self.resets)
            low, high = spec["limits"]
            controls = [self.model.actuator(name).id for name in spec["names"]]

            def control(action: Array) -> None:
                self.data.ctrl[controls] = np.clip(shape(action[columns]), low, high)

            return control
        asked = JointAction(spec, self.resets)
        names = asked.names
        at = np.array([self.joints[name][0] for name in names])

        def joints(action: Array) -> None:
            shift = np.array([self.default[name] - self.own_default[name] for name in names])
            # A robot's own encoders tell where it is.
            encoders = self.data.qpos[at] + self.bias_of(names)
            for kind, values in asked(action, encoders, shift).items():
                self.targets[kind].update(zip(names, values, strict=True))

        return joints

    def _law(self, spec: LawSpec) -> Callable[[], None]:
        """Return a function that sets some actuators' controls from their joints' targets before each substep."""
        names = spec["joints"]
        takes = spec["takes"]
        kind = spec["kind"]
        pos = np.array([self.joints[name][0] for name in names], int)
        vel = np.array([self.joints[name][1] for name in names], int)
        ctrl = [self.model.actuator(name).id for name in spec["actuators"]]
        numbers = {key: np.asarray(value, np.float64) for key, value in spec["numbers"].items()}
        # The closure below reads this dict, so a recorded start can replace gains in it.
        self.numbers = getattr(self, "numbers", []) + [(names, numbers)]
        lag = Lag(spec["delay"], self) if spec["delay"] else None
        self.lags += [lag] if lag else []
        scale = np.asarray(spec["scale"])
        offset = np.asarray(spec["offset"])

        # Targets stay the same for all substeps of an env step; measured state does not.
        def law() -> None:
            target = {}
            for key in KINDS:
                target[key] = np.array([self.targets[key][name] for name in names])
            if lag:
                late = lag(np.concatenate([target[key] for key in takes]))
                target |= dict(zip(takes, np.split(late, len(takes)), strict=True))
            # A robot's servo reads its encoder; the ones of this model see true positions.
            target["pos"] = target["pos"] - self.bias_of(names)
            # MuJoCo's own servo computes the effort; it only takes a target in the control's units.
            if kind == "builtin":
                self.data.ctrl[ctrl] = target[takes[0]] * scale + offset
                return
            # Ideal PD at the joint, with a feed-forward effort.
            now = self.data.qpos[pos]
            moves = self.data.qvel[vel]
            effort = target["effort"] + numbers["stiffness"] * (target["pos"] - now)
            effort = effort + numbers["damping"] * (target["vel"] - moves)
            limit = numbers["effort_limit"]
            low = -limit
            high = limit
            # Torque-speed line: the torque left at a speed falls to none at the no-load speed.
            if kind == "dc_motor":
                stall = numbers["saturation_effort"]
                lost = stall * moves / numbers["velocity_limit"]
                lowest = np.clip(-stall - lost, low, high)
                high = np.clip(stall - lost, low, high)
                low = lowest
            self.data.ctrl[ctrl] = np.clip(effort, low, high)

        return law

    # -- episodes ------------------------------------------------------------------------------------------------

    def reset(self, start: dict[str, Array] | None = None) -> Array:
        """Begin an episode at the default pose, or where a recorded one began; return the first frame."""
        mujoco.mj_resetData(self.model, self.data)
        # An export's keyframe 0 is the default pose; the model's own qpos0 need not be.
        if self.model.nkey:
            mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        for name, value in (start or {}).items():
            self._apply(name, value)
        self.steps = 0
        self.terminated = False
        self.action = self.last_action = np.zeros_like(self.action)
        for kind in KINDS:
            self.targets[kind] = (
                dict(self.default) if kind == "pos" else dict.fromkeys(self.joints, 0.0)
            )
        self.drawn.clear()
        networks = (self.policy, self.readings, self.scores)
        parts = (*networks, *self.lags, *self.noises, *self.contacts.values(), self.sight)
        for part in parts:
            part.reset()
        for forget in self.resets:
            forget()
        # Forces and accelerations read 0 until the first substep: `refresh` does not compute them.
        self.data.sensordata[:] = 0.0
        self.refresh()
        self.frame = self.observe(advances=False)
        return self.frame

    def _apply(self, name: str, value: Array) -> None:
        kind, _, field = name.partition("/")
        if kind in STATE:
            getattr(self.data, kind)[:] = value
        elif kind == "gravity":
            self.model.opt.gravity[:] = value
        elif kind == "model":
            whole = getattr(self.model, field)  # one that `check_record` lets through
            whole[:] = np.reshape(value, np.shape(whole))
            # Recompute derived constants. It overwrites the data that it gets, hence not ours.
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        elif kind == "encoder_bias":
            self.bias = dict(zip(self.joints, value, strict=True))
        elif kind == "default_pos":
            self.default = dict(zip(self.joints, value, strict=True))
        elif kind == "actuator":
            by_joint = dict(zip(self.joints, value, strict=True))
            for names, numbers in self.numbers:
                if field in numbers:
                    numbers[field] = np.array([by_joint[n] for n in names])

    def act(self) -> Array:
        """Return the policy's action for the newest frame."""
        return self.policy(self.frame, self.pictures)

    def step(
        self, action: Array, command: dict[str, Array] | None = None, *, observes: bool = True
    ) -> Json:
        """Run one env step; return rewards by term, metrics and the ending. `command` holds from the next frame on.

        A command beyond the ranges of the training is refused by a ValueError.
        """
        for name, values in (command or {}).items():
            if name not in self.ranges:
                raise ValueError(f"command {name!r}: expected one of {sorted(self.ranges)}")
            self.ranges[name].check(values)
        return self._run_step(action, command, observes=observes)

    def _run_step(
        self, action: Array, command: dict[str, Array] | None, *, observes: bool = True
    ) -> Json:
        """Run one env step, with a recorded command or a checked one."""
        # Stages of the chain hold memory: run each of them once per env step.
        for change in self.chain:
            action = change(action)
        self.last_action, self.action = self.action, np.asarray(action, np.float64)
        for write in self.asked:
            write(self.action)
        self.run_physics(self.laws)
        # Endings come before rewards, since a reward may read whether the episode was terminated.
        scores = self.scores.named(self.scored)
        endings = self.meta["terminations"]
        ended = [name for name in endings if scores["terminations", name]]
        finite = bool(np.isfinite(self.data.qpos).all() and np.isfinite(self.data.qvel).all())
        self.terminated = not finite or any(not endings[name]["time_out"] for name in ended)
        if "terminated" in self.scores.read:
            scores = self.scores.named(self.scored)
        self.scores.advance()
        unit = self.step_dt if self.meta["scale_rewards_by_dt"] else 1.0
        rewards = {}
        for name, spec in self.meta["rewards"].items():
            rewards[name] = spec["weight"] * unit * scores["rewards", name]
        metrics = {name: scores["metrics", name] for name in self.meta["metrics"]}
        # Rewards above belong to the old command; the next frame already shows the new one.
        self.command |= command or {}
        if observes:
            self.frame = self.observe()
        timed = 0 < self.limit <= self.steps
        return {
            "rewards": rewards if finite else dict.fromkeys(rewards, 0.0),
            "metrics": metrics,
            "terminated": self.terminated,
            "done": self.terminated or timed or bool(ended),
        }

    def run_physics(self, laws: Sequence[Callable[[], None]]) -> None:
        """Run the substeps of one env step, each after the laws that set its controls."""
        dt = self.model.opt.timestep
        for substep in range(self.decimation):
            for law in laws:
                law()
            mujoco.mj_step(self.model, self.data)
            for tracker in self.contacts.values():
                if tracker.every:
                    tracker.update(self.data, dt, starts=not substep)
        for keep in self.of_contacts:
            keep()
        # mj_step integrates last: derived poses and sensors lag behind qpos by a substep.
        self.refresh()
        self.steps += 1
        for tracker in self.contacts.values():
            if not tracker.every:
                tracker.update(self.data, self.step_dt, starts=True)

    def _begin(self, record: dict[str, Array], number: int) -> None:
        self.command |= self._commands(record, number, 0)
        self.reset(
            {name[6:]: value[number] for name, value in record.items() if name.startswith("start/")}
        )

    def _commands(self, record: dict[str, Array], number: int, step: int) -> dict[str, Array]:
        # The last command holds where an episode lasts longer than all recorded ones.
        every = {name: record[f"command/{name}"][number] for name in self.command}
        return {name: values[min(step, len(values) - 1)] for name, values in every.items()}

    def _push(self, record: dict[str, Array], number: int, step: int) -> None:
        pushes = record["pushes"]
        for push in pushes[(pushes[:, 0] == number) & (pushes[:, 1] == step)]:
            self.data.qvel[:] += push[2:]

    def _recorded_pictures(self, trace: dict[str, Array], t: int) -> dict[str, Array]:
        """Return the pictures that the policy read in a recorded step."""
        found = {}
        for name, camera in self.sight.cameras.items():
            # Where nothing is late, these are the moment's.
            of_moment = trace[f"camera_{camera.spec['group']}"]
            found[name] = trace.get(name, of_moment)[t]
        return found

    def _pixels_off(self, trace: dict[str, Array], t: int) -> Json:
        """Return the share of pixels in which each camera sees the state of a recorded step otherwise."""
        found = {}
        for camera in self.sight.cameras.values():
            group = camera.spec["group"]
            found[f"off_{group}"] = camera.share_off(trace[f"camera_{group}"][t])
        return found

    def episode(self, record: dict[str, Array], number: int) -> dict[str, float]:
        """Run a recorded episode once more: its start, commands and pushes, with noise and lags drawn again."""
        self._begin(record, number)
        sums: dict[str, float] = {}
        joints = [at for _, at in self.joints.values()]
        result: Json = {"done": False}
        while not result["done"] and self.steps < (self.limit or 1000):
            action = self.act()
            self._push(record, number, self.steps)
            result = self._run_step(action, self._commands(record, number, self.steps + 1))
            now = {f"reward/{name}": value for name, value in result["rewards"].items()}
            now |= {f"metric/{name}": value for name, value in result["metrics"].items()}
            for name, tracker in self.contacts.items():
                now |= {
                    f"contact/{name}/{k}": touch
                    for k, touch in enumerate(tracker.fields["found"].tolist())
                }
            efforts = np.abs(self.data.qfrc_actuator[joints]).tolist()
            now |= {
                f"torque/{name}": effort for name, effort in zip(self.joints, efforts, strict=True)
            }
            for name, value in now.items():
                sums[name] = sums.get(name, 0.0) + value
        earned = {name: value for name, value in sums.items() if name.startswith("reward/")}
        means = {name: value / self.steps for name, value in sums.items() if name not in earned}
        ended = {"length": float(self.steps), "fell": float(result["terminated"])}
        return {"return": sum(earned.values()), **ended, **earned, **means}

    def replay(self, record: dict[str, Array], number: int, lag: int) -> dict[str, Array]:
        """Run each recorded step by itself in this model; return frames, actions, targets, efforts, next states.

        Every step starts at the recorded state, with the recorded frame and action; lags are `lag` as far as they may.
        """
        trace = {
            name[6:]: v[number]
            for name, v in record.items()
            if name.startswith("trace/") and v.ndim
        }
        joints = [at for _, at in self.joints.values()]
        found = {}
        self.noisy = False
        self._begin(record, number)
        for delay in self.lags:
            delay.lag = min(max(lag, int(delay.spec["min"])), delay.most)
        for t in range(len(trace["done"])):
            for name in STATE:
                if name in trace:
                    getattr(self.data, name)[:] = trace[name][t]
            self.refresh()
            frame = self.observe() if t else self.frame
            recorded = trace["obs"][t] if trace["obs"].shape[1] == len(frame) else frame
            action = self.policy(recorded, self._recorded_pictures(trace, t))
            now = self._pixels_off(trace, t)
            self._push(record, number, t)
            self._run_step(
                trace["action"][t], self._commands(record, number, t + 1), observes=False
            )
            target = [self.targets[kind][name] for kind in KINDS for name in self.joints]
            now |= {
                "obs": frame,
                "action": action,
                "target": target,
                "effort": self.data.qfrc_actuator[joints],
            }
            now |= {"next_qpos": self.data.qpos, "next_qvel": self.data.qvel}
            now |= {
                f"found_{name}": tracker.fields["found"] for name, tracker in self.contacts.items()
            }
            for name, value in now.items():
                found.setdefault(name, []).append(np.array(value))
            if trace["done"][t]:
                break
        return {name: np.array(values) for name, values in found.items()}
