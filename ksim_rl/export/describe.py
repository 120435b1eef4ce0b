"""Describes the computation of terms as plain data, so that a program without this library computes the same.

A description is a tree: a number or a list of numbers; `{"quantity": name, ...}`, which is read from the robot; or
`{"op": name, "of": [...]}`, which is computed from other trees. All values are vectors; `runner.py` has both lists.
"""

import math
from collections.abc import Callable, Sequence
from functools import singledispatch
from typing import Any

from ksim_rl import mdp
from ksim_rl.envs.term import Term
from ksim_rl.envs.view import EnvView
from ksim_rl.export.standalone.files import Json
from ksim_rl.mdp.constants import values_by_name
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.sensors.rays import grid_points

Node = Json | float | list[float]
# What describes the terms of one class; each reads the fields of its own.
Maker = Callable[[Any, EnvView], Node]


class NotDescribedError(ValueError):
    """A term that has no description."""


@singledispatch
def describe(term: Any, view: EnvView) -> Node:
    """Return the description of a term; `describe.register(Kind)` adds one for terms of yours.

    Raises NotDescribedError where there is none.
    """
    kind = type(term)
    raise NotDescribedError(
        f"{kind.__name__} has no description: write a function (term, view) that returns one, and decorate it with "
        f"@ksim_rl.export.describe.register({kind.__name__}); docs/deploy.md has an example"
    )


def quantity(name: str, **parameters: Any) -> Node:
    """Return the description of something that is read."""
    return {"quantity": name, **parameters}


def op(name: str, *of: Node, **parameters: Any) -> Node:
    """Return the description of something that is computed."""
    return {"op": name, "of": list(of), **parameters}


def joint_names(view: EnvView, patterns: Patterns | None) -> list[str]:
    """Return the names of the hinges and slides that some patterns match, in the order of the patterns."""
    return list(view.joints(patterns).names)


def names_of(view: EnvView, kind: str, patterns: Patterns) -> list[str]:
    """Return the names of bodies, sites or actuators that some patterns match, in the order of the patterns."""
    every = view.resolver.names(kind)
    return [every[i] for i in view.resolver.ids(kind, patterns)]


def root(term: Any, view: EnvView) -> str:
    """Return the root body of a term's entity."""
    return view.entity(getattr(term, "entity", "")).root.name


def _add(kind: type[Term], make: Maker) -> None:
    describe.register(kind)(make)


def into_root(term: Any, view: EnvView, vectors: Node) -> Node:
    """Return vectors in the axes of the frame of a term."""
    # Velocities and forces only turn; positions are shifted too, see `points`.
    if term.frame == "root":
        return op("into", vectors, body=root(term, view))
    return vectors


def points(term: Any, view: EnvView, positions: Node) -> Node:
    """Return points of the world in the frame of a term."""
    if term.frame == "root":
        positions = op("subtract_point", positions, quantity("body_pos", bodies=[root(term, view)]))
    return into_root(term, view, positions)


def joints(name: str, *fields: str) -> Maker:
    """Return the description of a quantity of joints, with some fields of the term."""

    def described(term: Any, view: EnvView) -> Node:
        # Copied by name, so that the reader sees them beside the joints: {"biased": true}.
        own = {field: getattr(term, field) for field in fields}
        return quantity(name, joints=joint_names(view, term.joints), **own)

    return described


def contact(term: Any, field: str) -> Node:
    """Return a field that a contact sensor keeps: found, force, air_time, first_contact, ..."""
    return quantity("contact", sensor=term.sensor, field=field)


def force(term: Any) -> Node:
    """Return the size of the net force on each element of a contact sensor, N."""
    return op("norm", contact(term, "force"), width=3)


def bodies(name: str) -> Maker:
    """Return the description of a quantity of bodies."""
    # Later, when a term is described: patterns match names of the model at hand.
    return lambda t, v: quantity(name, bodies=names_of(v, "body", t.bodies))


def sites(name: str, term: Any, view: EnvView) -> Node:
    """Return the description of a quantity of sites."""
    return quantity(name, sites=names_of(view, "site", term.sites))


def _framed(name: str) -> Maker:
    """Describe a velocity of the root, in its own axes or the world's."""
    return lambda t, v: quantity(name, body=root(t, v), frame=t.frame)


def _gravity(term: mdp.ProjectedGravity, view: EnvView) -> Node:
    reading = quantity("projected_gravity", body=root(term, view))
    # Without a filter, and so without memory, a reading has the shortest description.
    if term.time_constant == 0.0:
        return reading
    return op("normalize", op("low_pass", reading, time_constant=term.time_constant))


def _clock(term: mdp.Clock, _: EnvView) -> Node:
    # Cycles since the episode began; each phase shifts them by a share of a cycle.
    cycles = op("multiply", term.frequency, quantity("time"))
    angle = op("multiply", 2.0 * math.pi, op("add", cycles, list(term.phases)))
    return op("concat", op("sin", angle), op("cos", angle))


def _imu(term: mdp.ImuReading, _: EnvView) -> Node:
    # An IMU is several MuJoCo sensors, told apart by the ends of their names.
    suffix = {"ang_vel": "gyro", "lin_acc": "accelerometer"}.get(term.quantity, "orientation")
    reading = quantity("sensor", sensor=f"{term.sensor}_{suffix}")
    if term.quantity == "projected_gravity":
        # Gravity's direction in the axes of the sensor's site, not of its body.
        return op("rotate_inverse", reading, [0.0, 0.0, -1.0])
    return reading


def _height_scan(term: mdp.HeightScan, view: EnvView) -> Node:
    # The grid's points in the root's axes, m; z is left out, since only x and y choose the point.
    grid = grid_points(term.size, term.resolution)[:, :2].tolist()
    below = quantity("height_scan", body=root(term, view), points=grid)
    return op("clip", op("subtract", below, term.offset), low=term.clip[0], high=term.clip[1])


def _signed_log(term: Any, _: EnvView) -> Node:
    newtons = contact(term, "force")
    # sign(f) log(1 + |f|): impacts of hundreds of newtons stay in the range of a network's inputs.
    return op("multiply", op("sign", newtons), op("log1p", op("absolute", newtons)))


_add(mdp.JointPos, joints("joint_pos", "biased"))
_add(mdp.JointPosRel, joints("joint_pos_rel", "biased"))
_add(mdp.JointVel, joints("joint_vel"))
_add(mdp.JointAcc, joints("joint_acc"))
_add(mdp.JointEffort, joints("joint_effort"))
_add(
    mdp.ActuatorForce, lambda t, v: quantity("actuator_force", actuators=names_of(v, "actuator", t.actuators))
)
_add(mdp.RootPos, lambda t, v: quantity("body_pos", bodies=[root(t, v)]))
_add(mdp.RootQuat, lambda t, v: quantity("body_quat", bodies=[root(t, v)]))
_add(mdp.RootRotation6d, lambda t, v: quantity("body_axes", bodies=[root(t, v)]))
_add(mdp.RootLinVel, _framed("root_lin_vel"))
_add(mdp.RootAngVel, _framed("root_ang_vel"))
_add(mdp.ProjectedGravity, _gravity)
_add(mdp.SensorReading, lambda t, v: quantity("sensor", sensor=t.sensor))
_add(mdp.LastAction, lambda t, v: quantity("action"))
_add(mdp.Command, lambda t, v: quantity("command", command=t.command))
_add(mdp.EpisodeTime, lambda t, v: quantity("time"))
_add(mdp.RemainingTime, lambda t, v: quantity("time_left"))
_add(mdp.Clock, _clock)
_add(mdp.ImuReading, _imu)
_add(mdp.HeightScan, _height_scan)
_add(mdp.BodyPos, lambda t, v: points(t, v, bodies("body_pos")(t, v)))
_add(mdp.BodyRotation6d, lambda t, v: into_root(t, v, bodies("body_axes")(t, v)))
_add(mdp.BodyLinVel, lambda t, v: into_root(t, v, bodies("body_lin_vel")(t, v)))
_add(mdp.BodyAngVel, lambda t, v: into_root(t, v, bodies("body_ang_vel")(t, v)))
_add(mdp.CenterOfMassPos, lambda t, v: points(t, v, bodies("com_pos")(t, v)))
_add(mdp.Contact, lambda t, v: op("greater", force(t), t.threshold))
_add(mdp.ContactForce, lambda t, v: into_root(t, v, contact(t, "force")))
_add(mdp.FootPos, lambda t, v: points(t, v, sites("site_pos", t, v)))
_add(mdp.FootHeight, lambda t, v: sites("site_height", t, v))
_add(mdp.FootAirTime, lambda t, v: contact(t, "air_time"))
_add(mdp.FootContact, lambda t, v: contact(t, "found"))
_add(mdp.FootContactForces, _signed_log)
_add(mdp.OffsetToBody, lambda t, v: _to_body(t, v))
_add(mdp.OffsetToCommand, lambda t, v: _to_target(t, v))


# -- rewards, terminations and metrics ---------------------------------------------------------------------------


def total(node: Node) -> Node:
    """Return the sum of a vector."""
    return op("sum", node)


def squared(node: Node) -> Node:
    """Return |x|^2."""
    return total(op("square", node))


def difference(one: Node, other: Node) -> Node:
    """Return one minus the other."""
    return op("subtract", one, other)


def some(node: Node, *indices: int) -> Node:
    """Return some numbers of a vector."""
    return op("take", node, indices=list(indices))


def rated(term: Any, squared_error: Node) -> Node:
    """Return exp(-error^2 / std^2)."""
    # A negative divisor saves an operation: exp(x / -std^2).
    return op("exp", op("divide", squared_error, -(term.std**2)))


def command(term: Any) -> Node:
    """Return the command of a term."""
    return quantity("command", command=term.command)


def speed(term: Any) -> Node:
    """Return |c_xy| + |c_z| of a velocity command."""
    asked = command(term)
    return op("add", op("norm", some(asked, 0, 1), width=2), op("absolute", some(asked, 2)))


def while_commanded(term: Any, value: Node) -> Node:
    """Return the value where the command asks to move, else 0."""
    return op("multiply", value, op("greater", speed(term), term.command_threshold))


def root_velocity(name: str, term: Any, view: EnvView) -> Node:
    """Return a velocity of the root in its own axes."""
    return quantity(name, body=root(term, view), frame="root")


def root_height(term: Any, view: EnvView) -> Node:
    """Return the height of the root above the ground."""
    return quantity("body_height", bodies=[root(term, view)])


def tilt(term: Any, view: EnvView) -> Node:
    """Return the squared sine of the tilt of a body."""
    # Gravity's direction is a unit vector: its x and y are the sine of the angle to the vertical.
    return squared(some(quantity("projected_gravity", body=term.body or root(term, view)), 0, 1))


def beyond(value: Node, low: Sequence[float] | float, high: Sequence[float] | float | None) -> Node:
    """Return how far values are outside of ranges; None is a range without an end."""
    # `clip` gives the nearest value inside of the range, so inside the distance is 0.
    return op("absolute", difference(value, op("clip", value, low=low, high=high)))


def table(term: Any, view: EnvView, field: str) -> list[float]:
    """Return a field's numbers by joint, in the order of the term's joints."""
    names = view.joints(term.joints).names
    return [float(value) for value in values_by_name(field, getattr(term, field), names)]


def foot_velocity(term: Any, view: EnvView) -> Node:
    """Return the horizontal velocities of feet."""
    return op("take", sites("site_lin_vel", term, view), indices=[0, 1], width=3)


def slip_velocity(term: Any, view: EnvView) -> Node:
    """Return the horizontal velocities of feet at the moment that contacts belong to."""
    return op("take", sites("site_lin_vel_of_contacts", term, view), indices=[0, 1], width=3)


def _place(t: Any, v: EnvView) -> Node:
    """Return where the body or site of a term is, in the world."""
    # Terms have a body or a site; the site is asked for first.
    if getattr(t, "site", None) is not None:
        return quantity("site_pos", sites=[t.site])
    return quantity("body_pos", bodies=[t.body])


def _to_target(t: Any, v: EnvView) -> Node:
    asked = some(command(t), 0, 1, 2)
    # A target in the root's frame: turn it into the world's axes and add where the root is.
    if t.frame == "root":
        turned = op("rotate", quantity("body_quat", bodies=[root(t, v)]), asked)
        asked = op("add", quantity("body_pos", bodies=[root(t, v)]), turned)
    return difference(asked, _place(t, v))


def _to_body(t: Any, v: EnvView) -> Node:
    return difference(quantity("body_pos", bodies=[t.body]), _place(t, v))


def _pose(t: mdp.Pose, v: EnvView) -> Node:
    # The gait follows from the speed that is asked for, and each gait has its own stds by joint.
    standing, walking, running = (table(t, v, f"std_{gait}") for gait in ("standing", "walking", "running"))
    moving = op("where", op("less", speed(t), t.running_threshold), walking, running)
    std = op("where", op("less", speed(t), t.walking_threshold), standing, moving)
    return op("exp", op("negative", op("mean", op("square", op("divide", _pos_rel(t, v), std)))))


# Rewards ask for true angles: these have no field `biased`.
_pos_rel = joints("joint_pos_rel")
_vel = joints("joint_vel")
_effort = joints("joint_effort")


def _swing_height(t: mdp.FootSwingHeight, v: EnvView) -> Node:
    landed = contact(t, "first_contact")
    # The peak since the foot left the ground; it counts at the landing only.
    peak = op("peak", sites("site_height", t, v), contact(t, "found"), landed)
    missed = op("square", difference(op("divide", peak, t.target_height), 1.0))
    return while_commanded(t, total(op("multiply", missed, landed)))


def _clearance(t: mdp.FootClearance, v: EnvView) -> Node:
    missed = op("absolute", difference(sites("site_height", t, v), t.target_height))
    return while_commanded(t, total(op("multiply", missed, op("norm", foot_velocity(t, v), width=2))))


def _slip(t: mdp.FootSlip, v: EnvView) -> Node:
    # Squared speed along the ground of each foot: blocks of two, x and y.
    speed2 = op("sum", op("square", slip_velocity(t, v)), width=2)
    return while_commanded(t, total(op("multiply", speed2, contact(t, "found"))))


def _air_time(t: mdp.FeetAirTime, _: EnvView) -> Node:
    time = contact(t, "air_time")
    # 1 for each foot whose flight is longer than the one and shorter than the other threshold.
    inside = op("multiply", op("greater", time, t.threshold_min), op("less", time, t.threshold_max))
    return while_commanded(t, total(inside))


def _tracked(t: Any, v: EnvView) -> tuple[Node, Node, Node]:
    """Return the command, and the root's linear and angular velocity in its own axes."""
    return command(t), root_velocity("root_lin_vel", t, v), root_velocity("root_ang_vel", t, v)


def _track_linear(t: mdp.TrackLinearVelocity, v: EnvView) -> Node:
    asked, moves, _ = _tracked(t, v)
    # The command has no z: a robot that tracks it does not move up or down.
    error = difference(op("concat", some(asked, 0, 1), [0.0]), moves)
    return rated(t, squared(error))


def _track_angular(t: mdp.TrackAngularVelocity, v: EnvView) -> Node:
    asked, _, turns = _tracked(t, v)
    # Roll and pitch rates should be 0, so they are part of the error.
    return rated(t, squared(difference(op("concat", [0.0, 0.0], some(asked, 2)), turns)))


def _beyond_limits(t: mdp.JointPosLimits, v: EnvView) -> Node:
    # The numbers of the built env: the runner knows no soft limits.
    low, high = v.joints(t.joints).soft_limits_L2.T.tolist()
    return total(beyond(joints("joint_pos")(t, v), low, high))


def _action_rate(*_: Term | EnvView) -> Node:
    return difference(quantity("action"), quantity("last_action"))


def changed(node: Node) -> Node:
    """Return the change of a value since the last step; before the first one it was 0."""
    return difference(node, op("previous", node))


def _bad_orientation(t: mdp.BadOrientation, v: EnvView) -> Node:
    # z of gravity's direction, negated, is the cosine of the tilt; falling over makes it small.
    upright = op("negative", some(quantity("projected_gravity", body=root(t, v)), 2))
    return op("less", upright, math.cos(t.limit_angle))


# Rewards that forces on bodies and the motion of feet give.
_add(mdp.ContactForceAbove, lambda t, v: total(op("maximum", difference(force(t), t.threshold), 0.0)))
_add(mdp.UndesiredContacts, lambda t, v: total(op("greater", force(t), t.threshold)))
_add(mdp.SelfCollision, lambda t, v: total(op("greater", contact(t, "peak_history"), t.threshold)))
_add(mdp.FootClearance, _clearance)
_add(mdp.FootSwingHeight, _swing_height)
_add(mdp.FootSlip, _slip)
_add(
    mdp.SoftLanding,
    lambda t, v: while_commanded(t, total(op("multiply", force(t), contact(t, "first_contact")))),
)
_add(mdp.FeetAirTime, _air_time)
_add(mdp.JointPosLimits, _beyond_limits)
# Costs of joints: distance from the default pose, speed, acceleration, effort, power.
_add(mdp.JointDeviationL1, lambda t, v: total(op("absolute", _pos_rel(t, v))))
_add(mdp.JointDeviationL2, lambda t, v: squared(_pos_rel(t, v)))
_add(mdp.JointVelL2, lambda t, v: squared(_vel(t, v)))
_add(mdp.JointAccL2, lambda t, v: squared(joints("joint_acc")(t, v)))
_add(mdp.JointEffortL2, lambda t, v: squared(_effort(t, v)))
_add(mdp.Energy, lambda t, v: total(op("absolute", op("multiply", _effort(t, v), _vel(t, v)))))
_add(mdp.Alive, lambda t, v: 1.0)
_add(mdp.Terminated, lambda t, v: quantity("terminated"))
# First, second and third difference of the actions: each `previous` reaches one step further back.
_add(mdp.ActionRateL2, lambda t, v: squared(_action_rate()))
_add(mdp.ActionAccelerationL2, lambda t, v: squared(changed(_action_rate())))
_add(mdp.ActionJerkL2, lambda t, v: squared(changed(changed(_action_rate()))))
# Commands that are tracked, and the posture of the root.
_add(mdp.TrackLinearVelocity, _track_linear)
_add(mdp.TrackAngularVelocity, _track_angular)
_add(mdp.TrackPosition, lambda t, v: rated(t, squared(_to_target(t, v))))
_add(mdp.NearBody, lambda t, v: rated(t, squared(_to_body(t, v))))
_add(mdp.TargetReached, lambda t, v: op("less", op("norm", _to_target(t, v), width=3), t.tolerance))
_add(mdp.Upright, lambda t, v: rated(t, tilt(t, v)))
_add(mdp.TiltL2, tilt)
_add(mdp.TrackRootHeight, lambda t, v: rated(t, squared(difference(command(t), root_height(t, v)))))
_add(mdp.RootHeightL2, lambda t, v: squared(difference(root_height(t, v), t.target_height)))
_add(mdp.Pose, _pose)
_add(mdp.LinVelZL2, lambda t, v: squared(some(root_velocity("root_lin_vel", t, v), 2)))
_add(mdp.AngVelXYL2, lambda t, v: squared(some(root_velocity("root_ang_vel", t, v), 0, 1)))
_add(mdp.BodyAngularVelocity, lambda t, v: squared(some(quantity("body_ang_vel", bodies=[t.body]), 0, 1)))
_add(mdp.AngularMomentum, lambda t, v: squared(quantity("sensor", sensor=t.sensor)))
# Terminations and metrics.
_add(mdp.BadOrientation, _bad_orientation)
_add(mdp.RootHeightBelow, lambda t, v: op("less", root_height(t, v), t.minimum_height))
_add(mdp.IllegalContact, lambda t, v: op("any", op("greater", force(t), t.threshold)))
_add(
    mdp.LinearVelocityError,
    lambda t, v: op("norm", some(difference(command(t), root_velocity("root_lin_vel", t, v)), 0, 1), width=2),
)
_add(
    mdp.AngularVelocityError,
    lambda t, v: op("absolute", some(difference(command(t), root_velocity("root_ang_vel", t, v)), 2)),
)
_add(mdp.ActionAcceleration, lambda t, v: op("mean", op("absolute", changed(_action_rate()))))
