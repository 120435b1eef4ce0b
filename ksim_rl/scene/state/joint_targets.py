"""Keeps the targets of joints, and writes them to the controls of MuJoCo's own actuators."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.physics import World
from ksim_rl.scene.names import (
    Index,
    NameResolver,
    Patterns,
    as_index,
    as_patterns,
    drives_scalar_joint,
    scalar_joint_ids,
)
from ksim_rl.scene.state.buffers import Buffers
from ksim_rl.scene.state.default_state import DefaultState
from ksim_rl.scene.state.joint_control import JointControl, TargetKind, joint_control


class JointState(NamedTuple):
    """Where N joints are before a substep: rad or m, and rad/s or m/s."""

    pos_EN: Float[Tensor, "E N"]
    vel_EN: Float[Tensor, "E N"]


class JointTarget(NamedTuple):
    """The targets of N joints: position, velocity, and effort (N m or N) to add."""

    pos_EN: Float[Tensor, "E N"]
    vel_EN: Float[Tensor, "E N"]
    effort_EN: Float[Tensor, "E N"]


ROUNDING = 1e-12
"""Up to here a keyframe's control asks for its own pose: rad, m, or per second."""
_WORDS = {"pos": "a position", "vel": "a velocity", "effort": "an effort"}


class Driven(NamedTuple):
    """An actuator of a joint, and the meaning of its control."""

    actuator: int
    control: JointControl


class _Line(NamedTuple):
    """The controls of some targets, `scale_K * target + offset_K`; None where all of the numbers are 1 or 0."""

    scale_K: Float[Tensor, " K"] | None
    offset_K: Float[Tensor, " K"] | None

    def of(self, target_EK: Float[Tensor, "E K"]) -> Float[Tensor, "E K"]:
        """Return the controls; of plain servos the targets themselves, bit for bit."""
        if self.scale_K is not None:
            target_EK = target_EK * self.scale_K
        if self.offset_K is None:
            return target_EK
        return target_EK + self.offset_K


class _Route(NamedTuple):
    """Where the targets of some joints go: columns of the buffers, and controls of built-in actuators, if any."""

    joints: Index
    ctrl: Index | None
    columns: Index
    line: _Line
    limits_K2: Float[Tensor, "K 2"] | None


class JointTargets:
    """Targets of all hinges and slides, in the model's order; rows that reset take the targets of the keyframe.

    A target of a built-in actuator becomes its control (`JointControl`); a motor model reads it before each substep.
    An actuator takes the kind of target that its gains make of its control, so that a position never ends up as the
    torque of a plain motor. Efforts of the MJCF's motors are their controls, before gear and gain.

    Targets of positions are readings of encoders, over which a robot's servo closes its loop. MuJoCo's servos and our
    laws see true positions instead, so that they get targets less the encoders' bias.
    """

    def __init__(
        self,
        world: World,
        resolver: NameResolver,
        buffers: Buffers,
        *,
        default_joint_pos_EL: Float[Tensor, "E L"],
        encoder_bias_EL: Float[Tensor, "E L"],
        default_state: DefaultState,
    ) -> None:
        model = world.mj_model
        num_joints = default_joint_pos_EL.shape[1]
        self._world = world
        self._resolver = resolver
        # A reset puts back the default pose, which events may have moved: `initial` is read each time.
        self.pos_EL = buffers.get("joint_pos_target_EL", num_joints, initial=default_joint_pos_EL)
        self.vel_EL = buffers.get("joint_vel_target_EL", num_joints)
        self.effort_EL = buffers.get("joint_effort_target_EL", num_joints)
        self._default_joint_pos_EL = default_joint_pos_EL
        self._encoder_bias_EL = encoder_bias_EL
        self._default_state = default_state
        self._buffers = {"pos": self.pos_EL, "vel": self.vel_EL, "effort": self.effort_EL}
        # Joints whose controls are written by a law before each substep, with the targets that it takes.
        self._driven_by_law: dict[int, Collection[TargetKind]] = {}
        # Look-ups by kind and patterns are done once, since actions write in each step.
        self._routes: dict[tuple[TargetKind, tuple[str, ...]], _Route] = {}

        # From the model's joint ids to places among hinges and slides.
        joint_of = {joint: number for number, joint in enumerate(scalar_joint_ids(model))}
        self._actuators: dict[int, list[Driven]] = {}
        for actuator in range(model.nu):
            if not drives_scalar_joint(model, actuator):
                continue
            joint = joint_of[int(model.actuator_trnid[actuator, 0])]
            driven = Driven(actuator, joint_control(model, actuator))
            self._actuators.setdefault(joint, []).append(driven)
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
        return found[0].actuator

    def driven(self, kind: TargetKind, joint: int) -> Driven:
        """Return the actuator of a joint that takes this kind of target; a ValueError where no control means it."""
        found = self._actuators.get(joint, [])
        # A joint may have several actuators, such as a position and a velocity servo.
        fitting = [driven for driven in found if driven.control.kind == kind]
        if not fitting:
            raise self._refusal(kind, joint, {driven.control.kind for driven in found})
        chosen = fitting[0]
        if chosen.control.refusal:
            name = self._resolver.names("actuator")[chosen.actuator] or chosen.actuator
            raise ValueError(
                f"joint {self._resolver.names('joint')[joint]!r} is asked for {_WORDS[kind]}, but no control of "
                f"actuator {name!r} means that: {chosen.control.refusal}; use ActuatorAction for its control, or give "
                "the robot another actuator (`actuators`, such as IdealPDActuator)"
            )
        return chosen

    def leave_to_law(self, joints: Sequence[int], takes: Collection[TargetKind]) -> None:
        """Keep the targets of these joints away from the controls: a law reads them, and writes those itself."""
        self._driven_by_law |= dict.fromkeys(joints, takes)
        # Remembered routes may lead to controls that now belong to the law.
        self._routes.clear()
        self._find_servos()

    def write(self, kind: TargetKind, patterns: Patterns, value_EK: Float[Tensor, "E K"]) -> None:
        """Set targets of joints in all rows, one column each in their order; a ValueError where one takes no such."""
        route = self._route_of(kind, patterns)
        # Clamped before it is kept, so that the target that terms read is the one in force.
        if route.limits_K2 is not None:
            value_EK = torch.clamp(value_EK, route.limits_K2[:, 0], route.limits_K2[:, 1])
        # All joints keep their targets here, also for laws that read them before each substep.
        self._buffers[kind][:, route.joints] = value_EK
        # Built-in actuators have their controls written here, in their own columns.
        if route.ctrl is not None:
            if kind == "pos":
                value_EK = value_EK - self._encoder_bias_EL[:, route.joints]
            self._world.ctrl_EL[:, route.ctrl] = route.line.of(value_EK[:, route.columns])

    def true_positions(self, joints: Index) -> Float[Tensor, "E K"]:
        """Return where joints truly are when their encoders read the targets, rad or m."""
        return self.pos_EL[:, joints] - self._encoder_bias_EL[:, joints]

    def follow_bias(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Let position servos in the rows of `mask_E` hold their targets, after the bias of encoders has changed."""
        if self._servo_ctrl is not None:
            ctrl_EL = self._world.ctrl_EL
            held_EL = self._servo_line.of(self.true_positions(self._servo_joints))
            ctrl_EL[:, self._servo_ctrl] = torch.where(
                mask_E[:, None], held_EL, ctrl_EL[:, self._servo_ctrl]
            )

    def limits(self, kind: TargetKind, patterns: Patterns) -> Float[Tensor, "K 2"] | None:
        """Return the limits that targets of joints are clamped to, (low, high); None if nothing limits them."""
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
        """Set the targets in the rows of `mask_E` as the keyframe's controls have them, until an action sets others.

        Without a keyframe position servos hold the default pose. They follow a default pose that events have moved.
        """
        rows_E1 = mask_E[:, None]
        for kind, beyond_L in self._asked_beyond.items():
            target_EL = self._buffers[kind]
            if kind == "pos":
                # The keyframe's deviation from its own pose, added to the default pose that holds now.
                asked_EL = beyond_L + self._default_joint_pos_EL
            else:
                asked_EL = beyond_L
            target_EL.copy_(torch.where(rows_E1, asked_EL, target_EL))
        ctrl_EL = self._world.ctrl_EL
        # Controls of all actuators that are not position servos, as the keyframe has them.
        if self._start_ctrl_L is not None:
            ctrl_EL.copy_(torch.where(rows_E1, self._start_ctrl_L, ctrl_EL))
        # Position servos follow the default pose of each env.
        self.follow_bias(mask_E)

    def _find_servos(self) -> None:
        """Find the position servos, which follow the default pose, and the targets of the default state beyond it."""
        device = self._world.device
        start = self._default_state
        num_joints = self.pos_EL.shape[1]
        # Places of hinges and slides in qpos.
        addresses = self._world.mj_model.jnt_qposadr[scalar_joint_ids(self._world.mj_model)]
        beyond = {kind: np.zeros(num_joints) for kind in self._buffers}
        servos: list[tuple[int, Driven]] = []
        other_ctrl_L = start.ctrl_L.copy()
        for joint, found in self._actuators.items():
            # A law computes the control from targets; nothing to write here.
            if joint in self._driven_by_law:
                continue
            for driven in found:
                if driven.control.refusal:
                    continue
                # The keyframe's control as a target at the joint.
                asked = driven.control.target(float(start.ctrl_L[driven.actuator]))
                if driven.control.kind == "pos":
                    asked -= float(start.qpos_L[addresses[joint]])
                    servos.append((joint, driven))
                    # Its control is computed from the default pose instead, in `reset`.
                    other_ctrl_L[driven.actuator] = 0.0
                # Rounding alone asks for nothing.
                if abs(asked) > ROUNDING:
                    beyond[driven.control.kind][joint] = asked
        self._asked_beyond = {
            kind: torch.tensor(numbers, device=device, dtype=torch.float32)
            for kind, numbers in beyond.items()
            if numbers.any()
        }
        # The controls that the world's own reset leaves at zero.
        self._start_ctrl_L = None
        if other_ctrl_L.any():
            self._start_ctrl_L = torch.tensor(other_ctrl_L, device=device, dtype=torch.float32)
        # None where there is nothing to write, so that a reset launches no kernel for it.
        if servos:
            self._servo_ctrl = as_index([driven.actuator for _, driven in servos], device)
        else:
            self._servo_ctrl = None
        self._servo_joints = as_index([joint for joint, _ in servos], device)
        self._servo_line = self._line([driven.control for _, driven in servos])

    def _line(self, controls: Sequence[JointControl]) -> _Line:
        """Return the controls of targets, without numbers that change nothing."""
        scale = [control.scale for control in controls]
        offset = [control.offset for control in controls]
        device = self._world.device
        # Plain servos have scale 1 and offset 0, and need no arithmetic in the step.
        is_scaled = any(number != 1.0 for number in scale)
        is_shifted = any(offset)
        return _Line(
            torch.tensor(scale, device=device, dtype=torch.float32) if is_scaled else None,
            torch.tensor(offset, device=device, dtype=torch.float32) if is_shifted else None,
        )

    def _route_of(self, kind: TargetKind, patterns: Patterns) -> _Route:
        key = (kind, as_patterns(patterns))
        if key not in self._routes:
            self._routes[key] = self._route(kind, key[1])
        return self._routes[key]

    def _route(self, kind: TargetKind, patterns: tuple[str, ...]) -> _Route:
        joints = self._resolver.ids("joint", patterns)
        ctrl: list[int] = []
        columns: list[int] = []
        controls: list[JointControl] = []
        for column, joint in enumerate(joints):
            # The target is kept for the law; it has no column of the controls here.
            if joint in self._driven_by_law:
                if kind not in self._driven_by_law[joint]:
                    raise self._refusal(kind, joint, self._driven_by_law[joint])
                continue
            # Refused where the joint's actuator takes another kind of target.
            driven = self.driven(kind, joint)
            ctrl.append(driven.actuator)
            controls.append(driven.control)
            columns.append(column)
        model = self._world.mj_model
        device = self._world.device
        limits_K2 = None
        # Only efforts are clamped here: a servo's control range does not clip its target.
        if kind == "effort" and any(model.actuator_ctrllimited[actuator] for actuator in ctrl):
            limits_K2 = torch.tensor([-torch.inf, torch.inf], device=device).repeat(len(joints), 1)
            for column, actuator in zip(columns, ctrl, strict=True):
                if model.actuator_ctrllimited[actuator]:
                    limits_K2[column] = torch.tensor(
                        model.actuator_ctrlrange[actuator], device=device
                    )
        return _Route(
            joints=self._resolver.index("joint", patterns),
            ctrl=as_index(ctrl, device) if ctrl else None,
            columns=as_index(columns, device),
            line=self._line(controls),
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
