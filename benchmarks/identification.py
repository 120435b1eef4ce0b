"""Identifies a robot of secret numbers: how far `ksim-rl identify` is from them.

    python -m benchmarks.identification --seed 7
    python -m benchmarks.identification --seed 0 1 2 3 4 5 6 7 8 9
    python -m benchmarks.identification --seed 1 --robot quadruped --seconds 20

The secret robot is a Go2 on MuJoCo's C engine, 16 times finer in time than the fit, with its base held. The seed draws
armature, damping, dry friction, gains and torque constant of each joint and the delay of the commands. Its encoders are
noisy and count in steps. It follows the commands that `ksim-rl identify --propose` wrote, and its log is what
`ksim-rl identify` reads; both run as commands. Figures go to benchmarks/results/identification.json: the largest error
of a joint's number, as a share, and the largest error of the delay, over all seeds that were asked for.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from benchmarks import command_line, report
from ksim_rl.checks import OneLineParser
from ksim_rl.identification.command import identify
from ksim_rl.identification.held_robot import robot_classes
from ksim_rl.scene.actuators import IdealPDActuator
from ksim_rl.scene.actuators.joint_drives import driven_joints
from ksim_rl.scene.state.joint_control import joint_control

PHYSICS_S = 0.00025
NOISE = 5e-4  # rad, the standard deviation of an encoder's reading
COUNT = 2.0 * np.pi / 2**14  # rad, the step of an encoder
# From low to high, as shares of what the robot's files say, or as they are.
ARMATURE = (0.6, 1.8)
STIFFNESS = (0.7, 1.4)
SERVO_DAMPING = (0.7, 1.4)
DAMPING = (0.05, 0.3)
FRICTIONLOSS = (0.1, 0.6)
TORQUE_CONSTANT = (0.8, 1.2)
DELAY_S = (0.002, 0.025)


@dataclass(frozen=True, kw_only=True)
class Errors:
    """How far a hidden robot's numbers were missed: the worst joint of each kind, as a share, and the delay, ms."""

    by_kind: dict[str, tuple[str, float]]
    delay_ms: float

    @property
    def largest(self) -> float:
        """The largest share."""
        return max(error for _, error in self.by_kind.values())


def main() -> int:
    """Hide numbers, find them, and write how far off they are; the code is 1 beyond 5 % or 2 ms."""
    parser = OneLineParser(prog="python -m benchmarks.identification", description=__doc__)
    parser.add_argument(
        "--seed", type=int, nargs="+", default=[0], help="of the secret numbers and the noise"
    )
    parser.add_argument("--robot", default="go2")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the log")
    options: Any = parser.parse_args()
    found: dict[int, Errors] = {}
    for seed in options.seed:
        found[seed] = find(options.robot, seed, options.seconds)
        path = write(options.robot, found)
    print(f"written to {path}")
    largest = max(errors.largest for errors in found.values())
    delay_ms = max(errors.delay_ms for errors in found.values())
    print(f"of {len(found)} seeds: largest error {largest:.2%}, delay off by {delay_ms:.3f} ms")
    return int(largest > 0.05 or delay_ms > 2.0)


def find(robot: str, seed: int, seconds: float) -> Errors:
    """Hide a robot's numbers, find them, and print how far off they are."""
    with tempfile.TemporaryDirectory() as folder:
        truth, found = hide_and_find(robot, seed, seconds, Path(folder))
    errors = Errors(
        by_kind=compare(truth, found),
        delay_ms=1e3 * abs(found["delay_s"]["value"] - truth["delay_s"]),
    )
    for kind, (joint, error) in errors.by_kind.items():
        print(f"{kind:<16}{error:8.2%}  {joint}")
    print(f"seed {seed}: largest error {errors.largest:.2%}, delay off by {errors.delay_ms:.3f} ms")
    return errors


def write(robot: str, found: dict[int, Errors]) -> Path:
    """Write the seeds that were run, and the worst of them."""
    # A list: in a mapping seeds of earlier runs would stay.
    seeds = []
    for seed, errors in found.items():
        seeds.append(
            {
                "seed": seed,
                "largest_error": errors.largest,
                "delay_error_ms": errors.delay_ms,
                "by_kind": {kind: error for kind, (_, error) in errors.by_kind.items()},
            }
        )
    return report.write(
        "identification",
        figures={
            "hidden_robot/largest_error": max(errors.largest for errors in found.values()),
            "hidden_robot/delay_error_ms": max(errors.delay_ms for errors in found.values()),
        },
        device=torch.device("cpu"),
        module="benchmarks.identification",
        robot=robot,
        seeds=seeds,
    )


def hide_and_find(
    robot: str, seed: int, seconds: float, folder: Path
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the secret numbers of a robot, and what the commands found of them."""
    plan = folder / "plan.csv"
    log = folder / "log.csv"
    found = folder / "found.json"
    targets = "pos,vel,effort"
    identify(
        ["--propose", robot, "--targets", targets, "--seconds", str(seconds), "--output", str(plan)]
    )
    hidden = HiddenRobot(robot, seed)
    log.write_text(hidden.follow(plan.read_text().splitlines()))
    identify([str(log), "--robot", robot, "--output", str(found)])
    return hidden.truth, json.loads(found.read_text())


def compare(truth: dict[str, Any], found: dict[str, Any]) -> dict[str, tuple[str, float]]:
    """Return the joint with the largest error of each kind of number, and that error as a share."""
    worst = {}
    for joint, numbers in truth["joints"].items():
        for kind, secret in numbers.items():
            value = found["joints"][joint][kind]["value"]
            # What was not told is wrong, here, where everything was commanded.
            error = float("inf") if value is None else abs(value / secret - 1.0)
            if error >= worst.get(kind, ("", -1.0))[1]:
                worst[kind] = (joint, error)
    return worst


class HiddenRobot:
    """A robot whose numbers come from a seed; `truth` has them."""

    def __init__(self, robot: str, seed: int) -> None:
        rng = np.random.default_rng([seed, 54])
        self._noise = np.random.default_rng([seed, 55])
        built = robot_classes()[robot]()
        spec = built.spec()
        for joint in list(spec.joints):
            if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                spec.delete(joint)
        # They are as long as with a free joint.
        for key in list(spec.keys):
            spec.delete(key)
        gains = _gains(built, spec.copy().compile())
        spec.option.timestep = PHYSICS_S
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        joints: dict[str, dict[str, float]] = {}
        # The law of each motor as MuJoCo's affine one, whose control the firmware computes from its commands.
        for actuator in spec.actuators:
            name = actuator.target
            joint = spec.joint(name)
            stiffness, damping, limit = gains[name]
            own = {
                "armature": float(joint.armature) * rng.uniform(*ARMATURE),
                "damping": rng.uniform(*DAMPING),
                "frictionloss": rng.uniform(*FRICTIONLOSS),
                "stiffness": stiffness * rng.uniform(*STIFFNESS),
                "servo_damping": damping * rng.uniform(*SERVO_DAMPING),
                "torque_constant": rng.uniform(*TORQUE_CONSTANT),
            }
            joint.armature = own["armature"]
            joint.damping = [own["damping"], 0.0, 0.0]
            joint.frictionloss = own["frictionloss"]
            actuator.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
            actuator.gainprm = [1.0, *[0.0] * 9]
            actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
            actuator.biasprm = [0.0, -own["stiffness"], -own["servo_damping"], *[0.0] * 7]
            actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
            actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            actuator.forcerange = [-limit, limit]
            joints[name] = own
        self.truth: dict[str, Any] = {"joints": joints, "delay_s": rng.uniform(*DELAY_S)}
        self._model = spec.compile()

    def follow(self, plan: Sequence[str]) -> str:
        """Return the log of the robot under the lines of a plan."""
        header = plan[0].split(",")
        table = np.loadtxt(plan[1:], delimiter=",")
        column = {name: table[:, place] for place, name in enumerate(header)}
        names = list(self.truth["joints"])
        control_TN = []
        for name in names:
            own = self.truth["joints"][name]
            asked_T = own["stiffness"] * column[f"{name}.target_position"]
            asked_T = asked_T + own["servo_damping"] * column[f"{name}.target_velocity"]
            control_TN.append(asked_T + own["torque_constant"] * column[f"{name}.target_effort"])
        starts = [column[f"{name}.target_position"][0] for name in names]
        pos_TN = self._run(column["time"], np.stack(control_TN, axis=1), starts)
        noisy_TN = pos_TN + self._noise.normal(0.0, NOISE, pos_TN.shape)
        counted_TN = np.round(noisy_TN / COUNT) * COUNT
        rows = np.hstack((table, counted_TN))
        lines = [",".join([*header, *(f"{name}.position" for name in names)])]
        lines += [",".join(f"{value:.9g}" for value in row) for row in rows]
        return "\n".join(lines) + "\n"

    def _run(
        self, time_T: np.ndarray, control_TN: np.ndarray, starts: Sequence[float]
    ) -> np.ndarray:
        model = self._model
        data = mujoco.MjData(model)
        names = list(self.truth["joints"])
        address = [int(model.joint(name).qposadr[0]) for name in names]
        data.qpos[address] = starts
        pos_TN = np.empty_like(control_TN)
        line = 0
        for step in range(int(round((time_T[-1] - time_T[0]) / PHYSICS_S)) + 1):
            now = time_T[0] + step * PHYSICS_S
            # An encoder is read as its time comes.
            while line < len(time_T) and now >= time_T[line] - 1e-9:
                pos_TN[line] = data.qpos[address]
                line += 1
            arrived = np.searchsorted(time_T, now - self.truth["delay_s"] + 1e-9, side="right") - 1
            data.ctrl[:] = control_TN[max(arrived, 0)]
            mujoco.mj_step(model, data)
        return pos_TN


def _gains(robot: Any, model: mujoco.MjModel) -> dict[str, tuple[float, float, float]]:
    """Return stiffness, damping and effort limit of each motor, as the robot's files have them."""
    found = {}
    names = [model.joint(joint).name for joint in range(model.njnt)]
    for entry, driven in driven_joints(getattr(robot, "actuators", ()), names):
        if isinstance(entry, IdealPDActuator):
            limit = entry.effort_limit or 1000.0
            found |= dict.fromkeys(driven, (entry.stiffness, entry.damping, limit))
    for actuator in range(model.nu):
        name = model.joint(model.actuator_trnid[actuator, 0]).name
        if name not in found:
            control = joint_control(model, actuator)
            found[name] = (
                control.stiffness,
                control.damping,
                float(model.actuator_forcerange[actuator, 1]),
            )
    return found


if __name__ == "__main__":
    command_line.run(main)
