"""This module holds what joints are asked for, and writes it to the controls of actuators that take it as it is."""

from collections.abc import Collection, Sequence
from typing import Literal, NamedTuple

import mujoco
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.physics import World
from ksim_rl.scene.names import Index, NameResolver, Patterns, as_index, as_patterns, scalar_joint_ids
from ksim_rl.scene.state.buffers import Buffers

TargetKind = Literal["pos", "vel", "effort"]


class JointState(NamedTuple):
    """Where N joints are before a substep: rad or m, and rad/s or m/s."""

    pos_EN: Float[Tensor, "E N"]
    vel_EN: Float[Tensor, "E N"]


class JointTarget(NamedTuple):
    """What N joints are asked for: position, velocity, and effort (N m or N) to add."""

    pos_EN: Float[Tensor, "E N"]
    vel_EN: Float[Tensor, "E N"]
    effort_EN: Float[Tensor, "E N"]


_WORDS = {"pos": "a position", "vel": "a velocity", "effort": "an effort"}


def control_kind(biastype: int, biasprm: Sequence[float], dyntype: int) -> TargetKind:
    """Return what the control of a MuJoCo actuator is a target for.

    A bias that pulls back in proportion to the position makes a position servo (with an integrator in front of it,
    one whose control is a velocity), one that is proportional to the velocity alone a velocity servo.
    """
    if biastype != mujoco.mjtBias.mjBIAS_AFFINE:
        return "effort"
    if biasprm[1] != 0.0:
        return "vel" if dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR else "pos"
    return "vel" if biasprm[2] != 0.0 else "effort"


class _Route(NamedTuple):
    """Where the targets of some joints go: columns of the buffers, and controls of built-in actuators, if any."""

    joints: Index
    ctrl: Index | None
    columns: Index
    limits_K2: Float[Tensor, "K 2"] | None


class JointTargets:
    """Targets of all hinges and slides, in the model's order; rows that reset are asked for the default pose, at rest.

    A target of a built-in actuator is its control and is written there too; a motor model reads it before each substep.
    An actuator takes the kind of target that its gains make of its control (see `control_kind`), so that a position
    never ends up as the torque of a plain motor. Efforts of the MJCF's motors are their controls, before gear and gain.
    """

    def __init__(
        self,
        world: World,
        resolver: NameResolver,
        buffers: Buffers,
        *,
        default_joint_pos_EL: Float[Tensor, "E L"],
    ) -> None:
        model, num_joints = world.mj_model, default_joint_pos_EL.shape[1]
        self._world, self._resolver = world, resolver
        self.pos_EL = buffers.get("joint_pos_target_EL", num_joints, initial=default_joint_pos_EL)
        self.vel_EL = buffers.get("joint_vel_target_EL", num_joints)
        self.effort_EL = buffers.get("joint_effort_target_EL", num_joints)
        self._buffers = {"pos": self.pos_EL, "vel": self.vel_EL, "effort": self.effort_EL}
        self._driven_by_law: dict[int, Collection[TargetKind]] = {}
        self._routes: dict[tuple[TargetKind, tuple[str, ...]], _Route] = {}

        joint_of = {joint: number for number, joint in enumerate(scalar_joint_ids(model))}
        self._actuators: dict[int, list[tuple[int, TargetKind]]] = {}
        for actuator in range(model.nu):
            joint = joint_of.get(int(model.actuator_trnid[actuator, 0]))
            of_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
            if not of_joint or joint is None:
                continue
            kind = control_kind(
                model.actuator_biastype[actuator],
                model.actuator_biasprm[actuator],
                model.actuator_dyntype[actuator],
            )
            self._actuators.setdefault(joint, []).append((actuator, kind))
        self._find_servos()

    def motor(self, joint: int) -> int:
        """Return the only actuator of a joint."""
        found = self._actuators.get(joint, [])
        if len(found) != 1:
            name = self._resolver.names("joint")[joint]
            raise ValueError(
                f"joint {name!r} has {len(found)} actuators in the model, but an entry in its robot's `actuators`: "
                "call `set_actuators(spec, self.actuators)` in the robot's spec()"
            )
        return found[0][0]

    def leave_to_law(self, joints: Sequence[int], takes: Collection[TargetKind]) -> None:
        """Keep the targets of these joints away from the controls: a law reads them, and writes those itself."""
        self._driven_by_law |= dict.fromkeys(joints, takes)
        self._routes.clear()
        self._find_servos()

    def write(self, kind: TargetKind, patterns: Patterns, value_EK: Float[Tensor, "E K"]) -> None:
        """Set targets of joints in all rows, one column each in their order; a ValueError where one takes no such."""
        route = self._route_of(kind, patterns)
        if route.limits_K2 is not None:
            value_EK = torch.clamp(value_EK, route.limits_K2[:, 0], route.limits_K2[:, 1])
        self._buffers[kind][:, route.joints] = value_EK
        if route.ctrl is not None:
            self._world.ctrl_EL[:, route.ctrl] = value_EK[:, route.columns]

    def limits(self, kind: TargetKind, patterns: Patterns) -> Float[Tensor, "K 2"] | None:
        """Return what targets of joints are clamped to, (low, high); None if nothing limits them."""
        return self._route_of(kind, patterns).limits_K2

    def check_no_law(self, actuators: Sequence[int]) -> None:
        """Refuse actuators whose controls a law writes, by a ValueError that names the joint."""
        for joint in self._driven_by_law:
            if self.motor(joint) in actuators:
                raise ValueError(
                    f"the control of joint {self._resolver.names('joint')[joint]!r} is written by a motor model before "
                    "each substep: use an action on joints"
                )

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Let the position servos of the rows of `mask_E` hold the default pose, until an action says otherwise."""
        if self._servo_ctrl is None:
            return
        ctrl_EL, held_EL = self._world.ctrl_EL, self.pos_EL[:, self._servo_joints]
        ctrl_EL[:, self._servo_ctrl] = torch.where(mask_E[:, None], held_EL, ctrl_EL[:, self._servo_ctrl])

    def _find_servos(self) -> None:
        servos = [
            (actuator, joint)
            for joint, found in self._actuators.items()
            for actuator, kind in found
            if kind == "pos" and joint not in self._driven_by_law
        ]
        device = self._world.device
        self._servo_ctrl = as_index([actuator for actuator, _ in servos], device) if servos else None
        self._servo_joints = as_index([joint for _, joint in servos], device)

    def _route_of(self, kind: TargetKind, patterns: Patterns) -> _Route:
        key = (kind, as_patterns(patterns))
        if key not in self._routes:
            self._routes[key] = self._route(kind, key[1])
        return self._routes[key]

    def _route(self, kind: TargetKind, patterns: tuple[str, ...]) -> _Route:
        joints = self._resolver.ids("joint", patterns)
        ctrl, columns = [], []
        for column, joint in enumerate(joints):
            if joint in self._driven_by_law:
                if kind not in self._driven_by_law[joint]:
                    raise self._refusal(kind, joint, self._driven_by_law[joint])
                continue
            found = self._actuators.get(joint, [])
            fitting = [actuator for actuator, of_kind in found if of_kind == kind]
            if not fitting:
                raise self._refusal(kind, joint, {of_kind for _, of_kind in found})
            ctrl.append(fitting[0])
            columns.append(column)
        model, device = self._world.mj_model, self._world.device
        limits_K2 = None
        if kind == "effort" and any(model.actuator_ctrllimited[actuator] for actuator in ctrl):
            limits_K2 = torch.tensor([-torch.inf, torch.inf], device=device).repeat(len(joints), 1)
            for column, actuator in zip(columns, ctrl, strict=True):
                if model.actuator_ctrllimited[actuator]:
                    limits_K2[column] = torch.tensor(model.actuator_ctrlrange[actuator], device=device)
        return _Route(
            joints=self._resolver.index("joint", patterns),
            ctrl=as_index(ctrl, device) if ctrl else None,
            columns=as_index(columns, device),
            limits_K2=limits_K2,
        )

    def _refusal(self, kind: TargetKind, joint: int, takes: Collection[TargetKind]) -> ValueError:
        name = self._resolver.names("joint")[joint]
        if not takes:
            driven = [self._resolver.names("joint")[i] for i in self._actuators]
            return ValueError(f"no actuator drives joint {name!r}: {near(name, driven)}")
        wanted = " or ".join(_WORDS[other] for other in sorted(takes))
        return ValueError(
            f"joint {name!r} is asked for {_WORDS[kind]}, but its actuator takes {wanted}: use that kind of action, or "
            "give the robot another actuator (`actuators`, such as IdealPDActuator)"
        )
