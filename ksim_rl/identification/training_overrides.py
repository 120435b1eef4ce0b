"""Turns identified parameters into overrides of `ksim-rl train`: a delay, ranges to draw from, and networks."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from ksim_rl.config.config_tree import to_tree
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import EventTerm
from ksim_rl.identification.findings import Estimate, Findings
from ksim_rl.mdp.randomization.joints import (
    RandomizeActuatorGains,
    RandomizeJointArmature,
    RandomizeJointDamping,
    RandomizeJointField,
    RandomizeJointFrictionLoss,
)
from ksim_rl.scene.actuators import Actuator, DelayedActuator, without_delay
from ksim_rl.scene.scene import scene_spec

EVENTS: Mapping[str, type[RandomizeJointField]] = {
    "armature": RandomizeJointArmature,
    "damping": RandomizeJointDamping,
    "frictionloss": RandomizeJointFrictionLoss,
}
LEAST_DELAY_S = 0.001
"""What is shorter makes no difference to a policy."""
GAINS = {"stiffness": "stiffness", "servo_damping": "damping"}
"""What `RandomizeActuatorGains` calls the numbers of a servo."""


def overrides(findings: Findings, cfg: ManagerBasedRlEnvCfg) -> list[str]:
    """Return the overrides for a task in whose scene the robot stands.

    One lets the robot's actuators get their targets late, the others draw each joint's numbers from their intervals. A
    ValueError says that the robot is not in the scene.
    """
    key = _robot_of(findings.robot, cfg)
    found = []
    actuators: Sequence[Actuator] = getattr(cfg.scene.robots[key], "actuators", ())
    # Servos of a model's own file have no entry that could be late.
    if actuators and findings.delay_s.is_told:
        late = _late(actuators, findings.delay_s, time_step(cfg))
        found.append(_driven_by(key, late))
    # Where robots are several, each has its name before its joints' names.
    prefix = "" if len(cfg.scene.robots) == 1 else f"{key}/"
    for name, event in _events(findings, prefix).items():
        found.append(f"+task.events.identified_{name}={_value(to_tree(event, EventTerm))}")
    return found


def left_out(findings: Findings, cfg: ManagerBasedRlEnvCfg) -> list[str]:
    """Return a line for each kind of number that was found and that no override carries."""
    key = _robot_of(findings.robot, cfg)
    found = []
    delay_s = findings.delay_s
    has_entries = bool(getattr(cfg.scene.robots[key], "actuators", ()))
    if not has_entries and delay_s.is_told and delay_s.high > LEAST_DELAY_S:
        found.append(
            f"the delay of {1e3 * delay_s.value:.1f} ms: servos of a model's own file cannot be late; give the robot "
            "`actuators`"
        )
    off = []
    for name, numbers in findings.joints.items():
        constant = numbers["torque_constant"]
        if constant.is_told and not constant.low <= 1.0 <= constant.high:
            off.append(f"{name} {constant.value:.3g}")
    if off:
        found.append(f"torque constants: divide commanded efforts by them: {', '.join(off)}")
    return found


def time_step(cfg: ManagerBasedRlEnvCfg) -> float:
    """Return the physics step of a task, s, in which delays and the past of networks count.

    A task that leaves it to the model has the model's.
    """
    return float(scene_spec(cfg.scene, cfg.sim).option.timestep)


def net_override(robot: str, entries: Sequence[Actuator], cfg: ManagerBasedRlEnvCfg) -> str:
    """Return the override that lets these entries drive a robot in a task.

    A ValueError says that the robot is not in the scene, or has no entries.
    """
    key = _robot_of(robot, cfg)
    if not hasattr(cfg.scene.robots[key], "actuators"):
        raise ValueError(
            f"--task: its robot {key!r} has no field `actuators`: give a task with another robot"
        )
    return _driven_by(key, entries)


def _driven_by(key: str, entries: Sequence[Actuator]) -> str:
    return f"task.scene.robots.{key}.actuators={_value(to_tree(entries, Sequence[Actuator]))}"


def _robot_of(name: str, cfg: ManagerBasedRlEnvCfg) -> str:
    for key, robot in cfg.scene.robots.items():
        if name in (key, getattr(robot, "name", None)):
            return key
    raise ValueError(
        f"--task: its robots are {', '.join(cfg.scene.robots)}, and none is {name!r}: give another task"
    )


def _late(actuators: Sequence[Actuator], delay_s: Estimate, timestep: float) -> list[Actuator]:
    """Return actuators with the delay that was found, in whole physics steps: rounded down to rounded up."""
    lags = {
        "min_lag": math.floor(delay_s.low / timestep),
        "max_lag": math.ceil(delay_s.high / timestep),
    }
    late: list[Actuator] = []
    for entry in actuators:
        # A delay that the robot had before is replaced.
        inner = without_delay(entry)
        late.append(DelayedActuator(actuator=inner, lag_group="bus", **lags))
    return late


def _events(findings: Findings, prefix: str) -> dict[str, EventTerm]:
    """Return an event for each kind of number that draws each joint's from its interval."""
    found: dict[str, EventTerm] = {}
    for kind, event in EVENTS.items():
        ranges: dict[int | str, tuple[float, float]] = {}
        for name, numbers in findings.joints.items():
            if numbers[kind].is_told:
                ranges[f"{prefix}{name}"] = _interval(numbers[kind])
        if ranges:
            found[kind] = event(joints=tuple(map(str, ranges)), ranges=ranges)
    for name, numbers in findings.joints.items():
        told = {GAINS[kind]: _interval(numbers[kind]) for kind in GAINS if numbers[kind].is_told}
        if told:
            found[f"gains_{name}"] = RandomizeActuatorGains(
                joints=(f"{prefix}{name}",),
                operation="abs",
                stiffness=told.get("stiffness"),
                damping=told.get("damping"),
            )
    return found


def _interval(number: Estimate) -> tuple[float, float]:
    return _rounded(number.low), _rounded(number.high)


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _value(tree: Any) -> str:
    """Return a tree in Hydra's grammar, without blanks, at which a shell would cut it."""
    if isinstance(tree, Mapping):
        return "{" + ",".join(f"{key}:{_value(value)}" for key, value in tree.items()) + "}"
    if isinstance(tree, (list, tuple)):
        return "[" + ",".join(map(_value, tree)) + "]"
    if tree is None:
        return "null"
    if isinstance(tree, bool):
        return str(tree).lower()
    if tree == "":
        return "''"
    return as_word(str(tree))


def as_word(text: str) -> str:
    """Return a text that a shell and Hydra take as it is; a ValueError refuses others."""
    if re.fullmatch(r"[\w./:+*-]+", text) is None:
        raise ValueError(
            f"--task: {text!r} cannot stand in words of a shell: letters, digits and ./:+*-_ can, so rename it"
        )
    return text
