"""Describes the terms that tasks of ours keep for themselves."""

import math
from typing import Any

from ksim_rl.envs.term import Term
from ksim_rl.envs.view import EnvView
from ksim_rl.export.describe import (
    Node,
    beyond,
    describe,
    difference,
    joint_names,
    op,
    quantity,
    root,
    root_height,
    some,
)
from ksim_rl.tasks import control_suite as control
from ksim_rl.tasks import get_up, planar

# The cart on its rail, m, and the pole's angle, 0 upright, rad.
CART, HINGE = (quantity("joint_pos", joints=[name]) for name in ("slider", "hinge"))


def tolerance(value: Node, low: float, high: float | None, margin: float) -> Node:
    """Return `mdp.rewards.tracking.tolerance` of the shape "gaussian"."""
    outside = op("divide", beyond(value, low, high), margin)
    # log(0.1): at one margin outside the value is 0.1, as in dm_control.
    return op("exp", op("multiply", math.log(0.1), op("square", outside)))


def linear(value: Node, low: float, margin: float, value_at_margin: float = 0.0) -> Node:
    """Return `mdp.rewards.tracking.tolerance` of the shape "linear", from `low` on."""
    outside = op("divide", beyond(value, low, None), margin)
    # Clamped: far away the line would go below zero.
    return op("maximum", difference(1.0, op("multiply", 1.0 - value_at_margin, outside)), 0.0)


def product(*of: Node) -> Node:
    """Return the product of some numbers."""
    if len(of) == 1:
        return of[0]
    # `multiply` takes two, so a product of more is nested.
    return op("multiply", of[0], product(*of[1:]))


def mean(one: Node, other: Node, weight: float = 1.0) -> Node:
    """Return the mean of two numbers, the first of them with a weight."""
    return op("divide", op("add", op("multiply", weight, one), other), weight + 1.0)


@describe.register(control.CartpolePosition)
def _position(*_: Term | EnvView) -> Node:
    # Cosine and sine, since an angle jumps after a turn.
    return op("concat", CART, op("cos", HINGE), op("sin", HINGE))


@describe.register(control.CartpoleReward)
def _reward(*_: Term | EnvView) -> Node:
    # The clip is the actuator's: commands beyond it cost no more.
    force = op("clip", op("take", quantity("action"), indices=[0]), low=-1.0, high=1.0)
    small_control = mean(1.0, difference(1.0, op("square", force)), weight=4.0)
    speed = quantity("joint_vel", joints=["hinge"])
    small_velocity = mean(1.0, tolerance(speed, 0.0, 0.0, 5.0))
    upright = mean(1.0, op("cos", HINGE))
    centered = mean(1.0, tolerance(CART, 0.0, 0.0, 2.0))
    return product(upright, centered, small_control, small_velocity)


@describe.register(control.PoleFallen)
def _fallen(term: control.PoleFallen, view: EnvView) -> Node:
    # The pole is upright where cos = 1; further from it than the limit is fallen.
    return op("less", op("cos", HINGE), math.cos(term.limit))


@describe.register(control.ReacherPose)
def _pose(*_: Term | EnvView) -> Node:
    shoulder, wrist = (quantity("joint_pos", joints=[name]) for name in ("shoulder", "wrist"))
    # The wrist is limited, so it needs no cosine and sine.
    return op("concat", op("cos", shoulder), op("sin", shoulder), wrist)


@describe.register(control.FingerToTarget)
def _to_target(term: Any, view: EnvView) -> Node:
    # A planar arm: z is the same for all targets.
    finger = some(quantity("site_pos", sites=["finger"]), 0, 1)
    return difference(quantity("command", command=term.command), finger)


@describe.register(control.ReacherReward)
def _reached(term: Any, view: EnvView) -> Node:
    distance = op("norm", _to_target(term, view), width=2)
    return tolerance(distance, 0.0, control.TARGET_RADIUS, 0.1)


@describe.register(control.PendulumAngle)
def _angle(term: Any, view: EnvView) -> Node:
    angle = quantity("joint_pos", joints=joint_names(view, ".*"))
    return op("concat", op("cos", angle), op("sin", angle))


@describe.register(control.PendulumReward)
def _swung_up(term: Any, view: EnvView) -> Node:
    names = joint_names(view, ".*")
    up = linear(op("cos", quantity("joint_pos", joints=names)), control.UPRIGHT, 1.0 + control.UPRIGHT)
    return product(up, mean(tolerance(quantity("joint_vel", joints=names), 0.0, 0.0, 5.0), 1.0, weight=4.0))


# -- planar robots -----------------------------------------------------------------------------------------------

# Planar robots have slides and a hinge in place of a free joint; x of the centre of mass is forward, m/s.
HEIGHT = quantity("joint_pos", joints=["root_z"])
FORWARD = some(quantity("sensor", sensor="com_velocity"), 0)


def upright(body: str) -> Node:
    """Return 1 where a body is upright, 0 where it is upside down."""
    # z of gravity's direction is -1 upright and 1 upside down: mapped to 1 and 0.
    return mean(1.0, op("negative", some(quantity("projected_gravity", body=body), 2)))


@describe.register(planar.ForwardSpeed)
def _forward_speed(*_: Term | EnvView) -> Node:
    return FORWARD


@describe.register(planar.CheetahReward)
def _runs(*_: Term | EnvView) -> Node:
    return linear(FORWARD, planar.CHEETAH_SPEED, planar.CHEETAH_SPEED)


@describe.register(planar.HopperReward)
def _hops(term: planar.HopperReward, view: EnvView) -> Node:
    # Height over the foot, so that a jump alone does not count as standing.
    above_foot = difference(HEIGHT, some(quantity("body_pos", bodies=["foot"]), 2))
    tall = tolerance(above_foot, planar.HOPPER_HEIGHT, None, planar.HOPPER_HEIGHT / 2)
    # Without a speed the task is to stand, and small actions are paid instead.
    if term.speed:
        return product(tall, upright(root(term, view)), linear(FORWARD, term.speed, term.speed))
    action = op("clip", quantity("action"), low=-1.0, high=1.0)
    small_effort = op("mean", difference(1.0, op("square", action)))
    return product(tall, upright(root(term, view)), mean(1.0, small_effort, weight=4.0))


@describe.register(planar.WalkerReward)
def _walks(term: planar.WalkerReward, view: EnvView) -> Node:
    tall = tolerance(HEIGHT, planar.WALKER_HEIGHT, None, planar.WALKER_HEIGHT / 2)
    # Standing is three parts height, one part upright.
    stands = mean(tall, upright(root(term, view)), weight=3.0)
    if not term.speed:
        return stands
    # One sixth of the reward is left without any speed, so that standing pays first.
    return product(stands, mean(linear(FORWARD, term.speed, term.speed / 2, 0.5), 1.0, weight=5.0))


@describe.register(planar.WalkAt)
def _walks_at(term: planar.WalkAt, view: EnvView) -> Node:
    return tolerance(FORWARD, term.speed - 0.1, term.speed + 0.1, term.speed)


# -- getting up --------------------------------------------------------------------------------------------------


@describe.register(get_up.Uprightness)
def _uprightness(term: Any, view: EnvView) -> Node:
    return upright(root(term, view))


@describe.register(get_up.RisenHeight)
def _risen(term: Any, view: EnvView) -> Node:
    return op("clip", op("divide", root_height(term, view), term.standing_height), low=0.0, high=1.0)


@describe.register(get_up.Standing)
def _standing(term: get_up.Standing, view: EnvView) -> Node:
    names = joint_names(view, ".*")
    # Squared: half risen earns a quarter.
    up = op("square", product(upright(root(term, view)), _risen(term, view)))
    stray = op("mean", op("square", op("divide", quantity("joint_pos_rel", joints=names), term.pose_std)))
    motion = op("mean", op("square", op("divide", quantity("joint_vel", joints=names), term.speed_std)))
    return product(up, op("exp", op("negative", op("add", stray, motion))))


@describe.register(get_up.Stands)
def _stands(term: get_up.Stands, view: EnvView) -> Node:
    is_high = op("greater", root_height(term, view), 0.85 * term.standing_height)
    down = some(quantity("projected_gravity", body=root(term, view)), 2)
    # Up is a tilt below 0.35 rad (20 degrees).
    return product(is_high, op("less", down, -math.cos(0.35)))
