"""The model in which joints are identified: a robot whose base is held, with the law of its motors as MuJoCo's own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.checks import near
from ksim_rl.physics import load_spec
from ksim_rl.scene import robots
from ksim_rl.scene.actuators import Actuator, without_delay
from ksim_rl.scene.actuators.actuator import ExplicitActuator
from ksim_rl.scene.actuators.joint_drives import driven_joints
from ksim_rl.scene.names import actuators_of_joint, scalar_joint_ids
from ksim_rl.scene.robots.edit import drop_bodies
from ksim_rl.scene.state.joint_control import TargetKind, effort_limit, joint_control

TIME_STEP = 0.002
"""Of the simulation, s: with the Runge-Kutta integrator its error is far below what encoders resolve."""
TARGETS: tuple[TargetKind, ...] = ("pos", "vel", "effort")
KINDS = ("armature", "damping", "frictionloss", "stiffness", "servo_damping", "torque_constant")
"""The numbers of a joint, in the order in which they are fitted."""


@dataclass(frozen=True, kw_only=True)
class DrivenJoint:
    """A joint with a motor, and its numbers as the robot's files have them.

    Attributes:
        name: of the joint.
        limb: which independent part of the held robot it belongs to.
        range: rad or m; infinite without limits.
        effort_limit: N m or N; infinite without a limit.
        takes: the kinds of target that its motor follows.
        nominal: by the names of `KINDS`.
        rest: its position in the robot's default pose, rad or m.
    """

    name: str
    limb: int
    range: tuple[float, float]
    effort_limit: float
    takes: frozenset[TargetKind]
    nominal: Mapping[str, float]
    rest: float


@dataclass(frozen=True, kw_only=True)
class HeldRobot:
    """A robot whose base does not move, and whose parts touch nothing.

    The effort of each joint is `torque_constant * effort + stiffness * (position - q) + servo_damping * (velocity - v)`
    of its targets, within its effort limit; the joint itself has armature, damping and dry friction. `mj_model` has one
    actuator for each of `joints`, in this order, whose control is what the targets give to that sum.
    """

    name: str
    spec: mujoco.MjSpec
    mj_model: mujoco.MjModel
    joints: tuple[DrivenJoint, ...]

    @property
    def joint_names(self) -> list[str]:
        """The driven joints, in the model's order."""
        return [joint.name for joint in self.joints]

    def nominal_NP(self) -> Float[np.ndarray, "N P"]:
        """Return the joints' numbers as the robot's files have them, by joint and `KINDS`."""
        rows = []
        for joint in self.joints:
            rows.append([joint.nominal[kind] for kind in KINDS])
        return np.array(rows)

    def limbs(self) -> list["HeldRobot"]:
        """Return the robot's independent parts, each alone: what moves in one has no effect on another."""
        mj_model = self.mj_model
        # A part begins at a body whose parent stands still.
        is_moving = mj_model.body_treeid >= 0
        beginnings = np.flatnonzero(is_moving & ~is_moving[mj_model.body_parentid])
        found = []
        for limb in sorted({joint.limb for joint in self.joints}):
            spec = self.spec.copy()
            others = beginnings[mj_model.body_treeid[beginnings] != limb]
            drop_bodies(spec, [mj_model.body(int(body)).name for body in others])
            joints = tuple(joint for joint in self.joints if joint.limb == limb)
            found.append(
                HeldRobot(name=self.name, spec=spec, mj_model=spec.compile(), joints=joints)
            )
        return found


def hold(robot: str, *, quat: Sequence[float] | None = None) -> HeldRobot:
    """Return a robot with its base held: one of the package by name, or a model's path or menagerie name.

    `quat` (w, x, y, z) is how the base is turned; by default as in the robot's first keyframe. A ValueError names
    what is unknown, and joints whose motors have no law that can be identified.
    """
    known = robot_classes()
    actuators: Sequence[Actuator] = ()
    if robot in known:
        built = known[robot]()
        spec = built.spec()
        actuators = getattr(built, "actuators", ())
    elif Path(robot).suffix or "/" in robot:
        spec = load_spec(robot)
    else:
        raise ValueError(f"--robot {robot}: {near(robot, known)}; or give the path of a model")
    standing_mj_model = spec.compile()
    # The first keyframe is the default pose, as everywhere.
    pose_L = standing_mj_model.qpos0
    if standing_mj_model.nkey:
        pose_L = standing_mj_model.key_qpos[0]
    motors = _motors(robot, standing_mj_model, actuators)
    _weld(spec, standing_mj_model, pose_L, quat)
    _leave_motors_alone(spec, motors)
    mj_model = spec.compile()
    joints = []
    for name, motor in motors.items():
        rest = float(pose_L[standing_mj_model.joint(name).qposadr[0]])
        joints.append(_driven_joint(mj_model, name, motor, rest))
    return HeldRobot(name=robot, spec=spec, mj_model=mj_model, joints=tuple(joints))


def robot_classes() -> dict[str, type]:
    """Return the package's robots by their names."""
    found = {}
    for value in vars(robots).values():
        name = getattr(value, "name", None)
        if isinstance(value, type) and isinstance(name, str):
            found[name] = value
    return found


@dataclass(frozen=True, kw_only=True)
class _Motor:
    """The nominal motor of a joint, from the robot's files, in units at the joint."""

    stiffness: float
    damping: float
    effort_limit: float
    takes: frozenset[TargetKind]


def _motors(
    robot: str, mj_model: mujoco.MjModel, actuators: Sequence[Actuator]
) -> dict[str, _Motor]:
    """Return the motors by the names of their joints, in the model's order."""
    names = [mj_model.joint(i).name for i in scalar_joint_ids(mj_model)]
    laws = {}
    for entry, driven in driven_joints(actuators, names):
        # A delay is found, and not taken from the robot.
        laws |= dict.fromkeys(driven, without_delay(entry))
    found = {}
    for name in names:
        of_joint = actuators_of_joint(mj_model, mj_model.joint(name).id)
        if not of_joint:
            continue
        if len(of_joint) > 1:
            raise ValueError(
                f"--robot {robot}: joint {name!r} has {len(of_joint)} actuators: expected one"
            )
        law = laws.get(name)
        if isinstance(law, ExplicitActuator):
            found[name] = _explicit(robot, name, law)
        else:
            found[name] = _builtin(robot, name, mj_model, of_joint[0])
    if not found:
        raise ValueError(f"--robot {robot}: no joint of it has a motor: give it actuators")
    return found


def _driven_joint(mj_model: mujoco.MjModel, name: str, motor: _Motor, rest: float) -> DrivenJoint:
    own = mj_model.joint(name)
    span = (-np.inf, np.inf)
    if mj_model.jnt_limited[own.id]:
        span = (float(own.range[0]), float(own.range[1]))
    nominal = {
        "armature": float(own.armature[0]),
        # Of three coefficients the first is the linear one.
        "damping": float(own.damping.flat[0]),
        "frictionloss": float(own.frictionloss[0]),
        "stiffness": motor.stiffness,
        "servo_damping": motor.damping,
        "torque_constant": 1.0,
    }
    return DrivenJoint(
        name=name,
        limb=int(mj_model.dof_treeid[own.dofadr[0]]),
        range=span,
        effort_limit=motor.effort_limit,
        takes=motor.takes,
        nominal=nominal,
        rest=rest,
    )


def _explicit(robot: str, name: str, law: ExplicitActuator) -> _Motor:
    """Return the motor of a law of ours, which knows its gains where it has any."""
    if "stiffness" not in law.params:
        kind = type(law).__name__
        raise ValueError(
            f"--robot {robot}: joint {name!r} is driven by a {kind}, which has no gains: give a robot with another one"
        )
    numbers = law.params
    return _Motor(
        stiffness=numbers["stiffness"],
        damping=numbers["damping"],
        effort_limit=numbers["effort_limit"],
        takes=law.takes,
    )


def _builtin(robot: str, name: str, mj_model: mujoco.MjModel, actuator: int) -> _Motor:
    """Return the motor of MuJoCo's own actuator."""
    control = joint_control(mj_model, actuator)
    if control.refusal:
        raise ValueError(f"--robot {robot}: the actuator of joint {name!r}: {control.refusal}")
    limit = effort_limit(mj_model, actuator)
    return _Motor(
        stiffness=control.stiffness,
        damping=control.damping,
        effort_limit=np.inf if limit is None else limit,
        takes=frozenset({control.kind}),
    )


def _weld(
    spec: mujoco.MjSpec, mj_model: mujoco.MjModel, pose_L: np.ndarray, quat: Sequence[float] | None
) -> None:
    """Take the free joints out, so that their bodies stay where they are in a pose."""
    for joint in list(spec.joints):
        if joint.type != mujoco.mjtJoint.mjJNT_FREE:
            continue
        body = joint.parent
        address = mj_model.jnt_qposadr[mj_model.body(body.name).jntadr[0]]
        body.pos = pose_L[address : address + 3]
        body.quat = pose_L[address + 3 : address + 7] if quat is None else quat
        spec.delete(joint)


def _leave_motors_alone(spec: mujoco.MjSpec, motors: Mapping[str, _Motor]) -> None:
    """Remove what does not affect the joints' motion, and give each joint the motor of `HeldRobot`."""
    for kind in (spec.keys, spec.sensors, spec.actuators):
        for element in list(kind):
            spec.delete(element)
    for name, motor in motors.items():
        bias = [0.0, -motor.stiffness, -motor.damping, *[0.0] * 7]
        new = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        new.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        new.biasprm = bias
        new.gainprm = [1.0, *[0.0] * 9]
        if np.isfinite(motor.effort_limit):
            new.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            new.forcerange = [-motor.effort_limit, motor.effort_limit]
    spec.option = mujoco.MjSpec().option
    spec.option.timestep = TIME_STEP
    # Of fourth order: what is found belongs to the robot and not to a time step.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    # Differences between simulations are taken: the solver must not stop early in one of them.
    spec.option.tolerance = 1e-12
