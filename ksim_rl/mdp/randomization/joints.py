"""These events draw properties of joints, tendons and actuators, where joints stand, and how they are read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant, index_constant
from ksim_rl.mdp.fields import OfJoints
from ksim_rl.mdp.randomization.randomize import (
    Operation,
    Pair,
    Randomize,
    RandomizeModelField,
    RandomizeNumber,
    write_entries,
)
from ksim_rl.scene.names import Patterns, actuators_of_joint, scalar_joint_ids
from ksim_rl.scene.state.joint_control import joint_control


@dataclass(frozen=True, kw_only=True)
class RandomizeJointField(OfJoints, RandomizeModelField):
    """Draw entries of a field of hinges and slides per world."""

    lowest = 0.0

    def ids(self, view: EnvView) -> tuple[int, ...]:
        """Return rows by joint, degree of freedom or generalized position, as the field's name says."""
        model = view.world.mj_model
        # Fields start with the kind of their rows: "jnt" by joint, "dof" by velocity, "qpos0" by position.
        places = {"jnt": np.arange(model.njnt), "dof": model.jnt_dofadr, "qpos0": model.jnt_qposadr}
        scalar = scalar_joint_ids(model)
        # The resolver counts hinges and slides only; the model's rows count all joints.
        joints = [scalar[i] for i in view.resolver.ids("joint", self.joints)]
        return tuple(int(i) for i in places[self.field.split("_")[0]][joints])


@dataclass(frozen=True, kw_only=True)
class RandomizeJointDamping(RandomizeJointField):
    """Viscous damping of joints, N m s / rad or N s / m."""

    field = "dof_damping"


@dataclass(frozen=True, kw_only=True)
class RandomizeJointArmature(RandomizeJointField):
    """Inertia that joints feel of their motors, kg m^2 or kg."""

    field = "dof_armature"


@dataclass(frozen=True, kw_only=True)
class RandomizeJointFrictionLoss(RandomizeJointField):
    """Dry friction of joints, N m or N."""

    field = "dof_frictionloss"


@dataclass(frozen=True, kw_only=True)
class RandomizeJointStiffness(RandomizeJointField):
    """Stiffness of the springs in joints, N m / rad or N / m; they pull towards the model's `springref`."""

    field = "jnt_stiffness"


@dataclass(frozen=True, kw_only=True)
class RandomizeJointRange(RandomizeJointField):
    """Limits of joints that have any, rad or m; columns: 0 lower, 1 upper. Soft limits stay as in the model."""

    field = "jnt_range"
    columns = 2

    operation: Operation = "add"

    def _check_reach(self, view: EnvView, nominal: np.ndarray, pairs: Mapping[int, Pair]) -> None:
        # The worst case of each end: the highest lower limit and the lowest upper limit must not cross.
        if 0 in pairs:
            lower = self.reach(nominal[:, 0], pairs[0])[1]
        else:
            lower = nominal[:, 0]
        if 1 in pairs:
            upper = self.reach(nominal[:, 1], pairs[1])[0]
        else:
            upper = nominal[:, 1]
        for row, joint in enumerate(self.ids(view)):
            name = view.world.mj_model.joint(joint).name
            if not view.world.mj_model.jnt_limited[joint]:
                raise ValueError(f"RandomizeJointRange: joint {name!r} has no limits: leave it out")
            if lower[row] >= upper[row]:
                raise ValueError(
                    f"RandomizeJointRange.ranges={self.ranges!r}: the lower limit of joint {name!r} would reach "
                    f"{lower[row]:g}, not below its upper limit {upper[row]:g}"
                )


@dataclass(frozen=True, kw_only=True)
class RandomizeJointZero(RandomizeJointField):
    """Where joints read zero (MuJoCo's `qpos0`), rad or m, by errors of assembly; bodies move by minus the change."""

    field = "qpos0"
    lowest = None

    operation: Operation = "add"


@dataclass(frozen=True, kw_only=True)
class RandomizeTendonField(RandomizeModelField):
    """Draw a field of tendons (names or patterns) per world."""

    lowest = 0.0

    tendons: Patterns


@dataclass(frozen=True, kw_only=True)
class RandomizeTendonStiffness(RandomizeTendonField):
    """Stiffness of tendons, N / m, or N m / rad of fixed tendons of hinges; they pull to the model's spring length."""

    field = "tendon_stiffness"


@dataclass(frozen=True, kw_only=True)
class RandomizeTendonDamping(RandomizeTendonField):
    """Viscous damping of tendons, N s / m or N m s / rad."""

    field = "tendon_damping"


@dataclass(frozen=True, kw_only=True)
class RandomizeTendonFrictionLoss(RandomizeTendonField):
    """Dry friction of tendons, N or N m."""

    field = "tendon_frictionloss"


@dataclass(frozen=True, kw_only=True)
class RandomizeTendonArmature(RandomizeTendonField):
    """Inertia against a change of tendons' lengths, kg or kg m^2."""

    field = "tendon_armature"


@dataclass(frozen=True, kw_only=True)
class RandomizeDefaultJointPos(OfJoints, RandomizeNumber):
    """The default pose, rad or m, from which resets, position actions and relative joint positions start.

    The model's own value is from its first keyframe or, without one, `qpos0`. In mode "reset" let it run before the
    event that resets the joints.
    """

    operation: Operation = "add"

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        joints = view.joints(self.joints)
        drawn_EN = self.draw(view, len(joints), [self.ranges])[..., 0]
        # From the keyframe, not from the last draw.
        value_EN = self.combine(view.default_qpos_L[joints.qpos], drawn_EN)
        held_EN = joints.default_pos_EL
        # Written in place, in the masked rows only.
        view.default_joint_pos_EL[:, joints.index] = torch.where(mask_E[:, None], value_EN, held_EN)


@dataclass(frozen=True, kw_only=True)
class RandomizeEncoderBias(OfJoints, RandomizeNumber):
    """Offset between a joint's position and its encoder's reading, rad or m.

    Observations show it with `JointPosRel(biased=True)`. A robot's servo closes its loop over the same encoder, so that
    a joint that is asked for a position stands off it by as much, the other way.
    """

    operation: Literal["abs"] = "abs"

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        joints = view.joints(self.joints)
        drawn_EN = self.draw(view, len(joints), [self.ranges])[..., 0]
        biased_EN = torch.where(mask_E[:, None], drawn_EN, joints.encoder_bias_EL)
        view.encoder_bias_EL[:, joints.index] = biased_EN
        view.targets.follow_bias(mask_E)


@dataclass(frozen=True, kw_only=True)
class RandomizeActuator(OfJoints, Randomize):
    """The base of the events of actuators; `joints` are driven ones."""

    operation: Operation = "scale"

    def _draw_explicit(
        self, view: EnvView, mask_E: Tensor, name: str, pair: Pair, finite: bool = False
    ) -> tuple[Tensor, list[int]]:
        """Draw a number for each joint, and write it where an explicit actuator has it; return the other places too."""
        joints = view.resolver.ids("joint", self.joints)
        # An infinite limit has no nominal value that a factor could change.
        owners = view.actuator_params.joints(name, finite=finite)
        # A shared draw has one column, which all joints take.
        drawn_ENC = self.draw(view, len(joints), [pair])
        drawn_EN = drawn_ENC[..., 0].expand(-1, len(joints))
        # Places among the matched joints, not ids.
        explicit = [i for i, joint in enumerate(joints) if joint in owners]
        if explicit:
            columns = index_constant([joints[i] for i in explicit], view.device)
            own_N = view.actuator_params.nominal(name)[columns]
            explicit_EN = drawn_EN[:, index_constant(explicit, view.device)]
            # A negative gain would push away from the target; the gaussian's tails may reach there.
            value_EN = self.combine(own_N, explicit_EN).clamp(min=0.0)
            held_EL = view.actuator_param(name)
            held_EL[:, columns] = torch.where(mask_E[:, None], value_EN, held_EL[:, columns])
        return drawn_EN, [i for i, joint in enumerate(joints) if joint not in owners]

    def _check_not_negative(
        self, field: str, names: Sequence[str], own: np.ndarray, pair: Pair
    ) -> None:
        low, _ = self.reach(own, pair)
        if np.any(low < 0.0):
            # The worst joint is named; `own` may have a low and a high end per joint.
            row = int(low.reshape(len(names), -1).min(-1).argmin())
            raise ValueError(
                f"{type(self).__name__}.{field}={pair!r}: joint {names[row]!r} would reach {low.min():g}; "
                "expected at least 0"
            )


@dataclass(frozen=True, kw_only=True)
class RandomizeActuatorGains(RandomizeActuator):
    """Gains of the servos that drive joints: stiffness, N m / rad or N / m; damping, N m s / rad or N s / m.

    Gains are meant at the joint, behind the gear. MuJoCo's position servo keeps its stiffness in its gain and its bias,
    its velocity servo the damping; all places are written, so that targets keep their meaning. Explicit actuators keep
    theirs in `EnvView.actuator_param`, never below 0. None leaves a gain alone.
    """

    drawn = ("stiffness", "damping")

    stiffness: Pair | None = None
    damping: Pair | None = None
    per_world_fields: ClassVar[tuple[str, ...]] = ("actuator_gainprm", "actuator_biasprm")

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        # Stiffness first; each gain is drawn by itself.
        for name in self.drawn:
            if getattr(self, name) is not None:
                self._write(view, mask_E, name, getattr(self, name))

    def _write(self, view: EnvView, mask_E: Tensor, name: str, pair: Pair) -> None:
        drawn_EN, builtin = self._draw_explicit(view, mask_E, name, pair)
        if not builtin:
            return
        model = view.world.mj_model
        names = [view.joints(self.joints).names[i] for i in builtin]
        servos = [_servo(model, model.joint(joint).id, name) for joint in names]
        # MuJoCo's bias is (constant, -kp, -kd).
        column = 1 if name == "stiffness" else 2
        before_gear = -model.actuator_biasprm[servos, column]
        gear = model.actuator_gear[servos, 0]
        # MuJoCo's bias acts on the actuator's length, gear * q, and its force through the gear again: hence
        # the square.
        own = before_gear * gear * gear
        self._check_not_negative(name, names, own, pair)
        drawn_EN = drawn_EN[:, index_constant(builtin, view.device)]
        value_EN = self.combine(array_constant(own, view.device), drawn_EN)
        # Back to before the gear.
        value_EN = _times(value_EN, 1.0 / (gear * gear))
        write_entries(
            view.field("actuator_biasprm"), servos, (column,), mask_E, -value_EN[..., None]
        )
        # The gain and the constant of a position servo, or of a velocity servo, are in proportion to it.
        leads = [i for i, servo in enumerate(servos) if _leading_column(model, servo) == column]
        if not leads:
            return
        rows = [servos[i] for i in leads]
        lead_EN = value_EN[:, index_constant(leads, view.device)]
        gain_EN = _times(lead_EN, model.actuator_gainprm[rows, 0] / before_gear[leads])
        write_entries(view.field("actuator_gainprm"), rows, (0,), mask_E, gain_EN[..., None])
        constants = model.actuator_biasprm[rows, 0]
        if constants.any():
            constant_EN = _times(lead_EN, constants / before_gear[leads])
            write_entries(
                view.field("actuator_biasprm"), rows, (0,), mask_E, constant_EN[..., None]
            )


@dataclass(frozen=True, kw_only=True)
class RandomizeEffortLimit(RandomizeActuator, RandomizeNumber):
    """Largest effort of the actuators of joints, N m or N behind the gear: one draw for both directions.

    It changes all that limits the effort: the actuator's force range, the joint's, both, or an explicit actuator's
    `effort_limit`, which stays at 0 or above.
    """

    per_world_fields: ClassVar[tuple[str, ...]] = ("actuator_forcerange", "jnt_actfrcrange")

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        # A factor or an offset cannot limit a joint without a limit: there, the limit of the joint itself may be meant.
        finite = self.operation != "abs"
        drawn_EN, builtin = self._draw_explicit(view, mask_E, "effort_limit", self.ranges, finite)
        model = view.world.mj_model
        names = view.joints(self.joints).names
        ranges: dict[str, dict[int, int]] = {"actuator_forcerange": {}, "jnt_actfrcrange": {}}
        for i in builtin:
            joint = model.joint(names[i]).id
            limited = [
                a for a in actuators_of_joint(model, joint) if model.actuator_forcelimited[a]
            ]
            # An effort limit may be kept in several places; all of them get the same draw.
            ranges["actuator_forcerange"] |= dict.fromkeys(limited, i)
            # A joint's own limit acts on the sum of its actuators.
            if model.jnt_actfrclimited[joint]:
                ranges["jnt_actfrcrange"][joint] = i
            elif not limited:
                raise ValueError(
                    f"RandomizeEffortLimit: nothing limits the effort on joint {names[i]!r}: give its "
                    "actuator an effort_limit (forcerange), or leave the joint out"
                )
        for field, place_of in ranges.items():
            if not place_of:
                continue
            rows = list(place_of)
            places = list(place_of.values())
            # The lower bound as a size, like the upper one; an actuator's range is before its gear.
            own = getattr(model, field)[rows] * np.array((-1.0, 1.0))
            gear_N1 = np.ones((len(rows), 1))
            if field == "actuator_forcerange":
                gear_N1 = np.abs(model.actuator_gear[rows, :1])
            own = own * gear_N1
            self._check_not_negative("ranges", [names[i] for i in places], own, self.ranges)
            limit_EN1 = drawn_EN[:, index_constant(places, view.device)][..., None]
            size_EN2 = self.combine(array_constant(own, view.device), limit_EN1).expand(-1, -1, 2)
            # Lower bounds are negative again, and an actuator's range is before its gear.
            signs_N2 = array_constant(np.array((-1.0, 1.0)) / gear_N1, view.device)
            write_entries(view.field(field), rows, (0, 1), mask_E, size_EN2 * signs_N2)


def _servo(mj_model: mujoco.MjModel, joint: int, gain: str) -> int:
    """Return the servo of a joint that has this gain: a velocity servo for the damping, if there is one."""
    position: int | None = None
    velocity: int | None = None
    for actuator in actuators_of_joint(mj_model, joint):
        control = joint_control(mj_model, actuator)
        if control.refusal or control.kind == "effort":
            continue
        # A servo with a bias against the position is a position servo.
        if _leading_column(mj_model, actuator) == 1:
            position = actuator
        else:
            velocity = actuator
    # With both kinds on one joint, damping belongs to the velocity servo.
    if gain == "damping" and velocity is not None:
        return velocity
    if position is not None:
        return position
    raise ValueError(
        f"RandomizeActuatorGains.{gain}: joint {mj_model.joint(joint).name!r} has no servo with this gain; expected a "
        "position or velocity actuator, or an explicit actuator"
    )


def _leading_column(mj_model: mujoco.MjModel, actuator: int) -> int:
    """Return the column of a servo's bias that its gain belongs to: 1 where it holds a position, else 2."""
    if mj_model.actuator_biasprm[actuator, 1] != 0.0:
        return 1
    return 2


def _times(value_EN: Float[Tensor, "E N"], factor_N: np.ndarray) -> Float[Tensor, "E N"]:
    """Return the products; factors of 1, as of plain servos, cost nothing."""
    if np.all(factor_N == 1.0):
        return value_EN
    return value_EN * array_constant(factor_N, value_EN.device)
