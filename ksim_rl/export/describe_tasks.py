"""This module describes the terms that tasks of ours keep for themselves."""

import math
from typing import Any

from ksim_rl.envs.view import EnvView
from ksim_rl.export.describe import Node, beyond, describe, difference, op, quantity, some
from ksim_rl.tasks import control_suite as control

CART, HINGE = (quantity("joint_pos", joints=[name]) for name in ("slider", "hinge"))


def tolerance(value: Node, low: float, high: float, margin: float) -> Node:
    """Return `mdp.rewards.tracking.tolerance` of the shape "gaussian"."""
    outside = op("divide", beyond(value, low, high), margin)
    return op("exp", op("multiply", math.log(0.1), op("square", outside)))


def mean(one: Node, other: Node, weight: float = 1.0) -> Node:
    """Return the mean of two numbers, the first of them with a weight."""
    return op("divide", op("add", op("multiply", weight, one), other), weight + 1.0)


@describe.register(control.CartpolePosition)
def _position(*_: Any) -> Node:
    return op("concat", CART, op("cos", HINGE), op("sin", HINGE))


@describe.register(control.CartpoleReward)
def _reward(*_: Any) -> Node:
    force = op("clip", op("take", quantity("action"), indices=[0]), low=-1.0, high=1.0)
    small_control = mean(1.0, difference(1.0, op("square", force)), weight=4.0)
    speed = quantity("joint_vel", joints=["hinge"])
    small_velocity = mean(1.0, tolerance(speed, 0.0, 0.0, 5.0))
    upright, centered = mean(1.0, op("cos", HINGE)), mean(1.0, tolerance(CART, 0.0, 0.0, 2.0))
    return op("multiply", op("multiply", upright, centered), op("multiply", small_control, small_velocity))


@describe.register(control.PoleFallen)
def _fallen(term: control.PoleFallen, view: EnvView) -> Node:
    return op("less", op("cos", HINGE), math.cos(term.limit))


@describe.register(control.ReacherPose)
def _pose(*_: Any) -> Node:
    shoulder, wrist = (quantity("joint_pos", joints=[name]) for name in ("shoulder", "wrist"))
    return op("concat", op("cos", shoulder), op("sin", shoulder), wrist)


@describe.register(control.FingerToTarget)
def _to_target(term: Any, view: EnvView) -> Node:
    finger = some(quantity("site_pos", sites=["finger"]), 0, 1)
    return difference(quantity("command", command=term.command), finger)


@describe.register(control.ReacherReward)
def _reached(term: Any, view: EnvView) -> Node:
    distance = op("norm", _to_target(term, view), width=2)
    return tolerance(distance, 0.0, control.TARGET_RADIUS, 0.1)
