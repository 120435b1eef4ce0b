"""These events draw gains and limits of actuators, MuJoCo's own and explicit ones alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant, constant, index_constant
from ksim_rl.mdp.randomization.randomize import (
    Operation,
    Pair,
    Randomize,
    RandomizeNumber,
    write_entries,
)
from ksim_rl.scene.names import Patterns, scalar_joint_ids

_JOINT_TRANSMISSIONS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


@dataclass(frozen=True, kw_only=True)
class RandomizeActuator(Randomize):
    """What the events of this file share.

    Attributes:
        joints: names or patterns of the driven joints.
    """

    joints: Patterns = ".*"
    operation: Operation = "scale"

    def _write_explicit(
        self,
        view: EnvView,
        name: str,
        joints: Sequence[int],
        mask_E: Bool[Tensor, " E"],
        drawn_EN: Tensor,
        *,
        finite: bool = False,
    ) -> list[int]:
        """Write a number of the explicit actuators among those of `joints`; return the places of the others."""
        owners = view.actuator_params.joints(name, finite=finite)
        explicit = [i for i, joint in enumerate(joints) if joint in owners]
        if explicit:
            columns = index_constant([joints[i] for i in explicit], view.device)
            own_N = view.nominal_actuator_param(name)[columns]
            drawn_EN = drawn_EN[:, index_constant(explicit, view.device)]
            value_EN, held_EL = self.combine(own_N, drawn_EN).clamp(min=0.0), view.actuator_param(name)
            held_EL[:, columns] = torch.where(mask_E[:, None], value_EN, held_EL[:, columns])
        return [i for i, joint in enumerate(joints) if joint not in owners]


@dataclass(frozen=True, kw_only=True)
class RandomizeActuatorGains(RandomizeActuator):
    """Gains of the servos that drive joints: stiffness, N m / rad or N / m; damping, N m s / rad or N s / m.

    MuJoCo's position servo keeps one stiffness in its gain and its bias, and its velocity servo one damping; both
    places are written. Explicit actuators keep theirs in `EnvView.actuator_param`, never below 0.

    Attributes:
        stiffness: what to draw from; None leaves it alone.
        damping: the same.
    """

    stiffness: Pair | None = None
    damping: Pair | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("stiffness", "damping"):
            if getattr(self, name) is not None:
                self.check_range(name, getattr(self, name))

    per_world_fields: ClassVar[tuple[str, ...]] = ("actuator_gainprm", "actuator_biasprm")

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        joints = view.resolver.ids("joint", self.joints)
        for name in ("stiffness", "damping"):
            pair = getattr(self, name)
            if pair is None:
                continue
            drawn_EN = self.draw(view, len(joints), [pair])[..., 0].expand(-1, len(joints))
            builtin = self._write_explicit(view, name, joints, mask_E, drawn_EN)
            if builtin:
                drawn_EN = drawn_EN[:, index_constant(builtin, view.device)]
                self._write_servos(view, name, [joints[i] for i in builtin], pair, mask_E, drawn_EN)

    def _write_servos(
        self,
        view: EnvView,
        name: str,
        joints: Sequence[int],
        pair: Pair,
        mask_E: Bool[Tensor, " E"],
        drawn_EN: Tensor,
    ) -> None:
        model = view.world.mj_model
        places = [_servo(model, scalar_joint_ids(model)[joint], name) for joint in joints]
        servos = [actuator for actuator, _ in places]
        column = 1 if name == "stiffness" else 2
        own = -model.actuator_biasprm[servos, column]
        check_not_negative(self, name, [view.resolver.names("joint")[j] for j in joints], own, pair)
        value_EN1 = self.combine(array_constant(own, view.device), drawn_EN)[..., None]
        write_entries(view.field("actuator_biasprm"), servos, (column,), mask_E, -value_EN1)
        in_gain = [i for i, (_, also_gain) in enumerate(places) if also_gain]
        if in_gain:
            gains_EN1 = value_EN1[:, index_constant(in_gain, view.device)]
            write_entries(
                view.field("actuator_gainprm"), [servos[i] for i in in_gain], (0,), mask_E, gains_EN1
            )


@dataclass(frozen=True, kw_only=True)
class RandomizeEffortLimit(RandomizeActuator, RandomizeNumber):
    """Largest effort of the actuators of joints, N m or N: one draw for both directions.

    It changes what holds the effort: the actuator's force range, the joint's, both, or an explicit actuator's
    `effort_limit`, which stays at 0 or above.
    """

    per_world_fields: ClassVar[tuple[str, ...]] = ("actuator_forcerange", "jnt_actfrcrange")

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        joints = view.resolver.ids("joint", self.joints)
        drawn_EN = self.draw(view, len(joints), [self.ranges])[..., 0].expand(-1, len(joints))
        # A factor or an offset cannot limit what has no limit: there, the limit of the joint itself may be meant.
        builtin = self._write_explicit(
            view, "effort_limit", joints, mask_E, drawn_EN, finite=self.operation != "abs"
        )
        model, ranges = view.world.mj_model, {"actuator_forcerange": {}, "jnt_actfrcrange": {}}
        for i in builtin:
            joint = scalar_joint_ids(model)[joints[i]]
            limited = [a for a in _actuators(model, joint) if model.actuator_forcelimited[a]]
            ranges["actuator_forcerange"] |= dict.fromkeys(limited, i)
            if model.jnt_actfrclimited[joint]:
                ranges["jnt_actfrcrange"][joint] = i
            elif not limited:
                raise ValueError(
                    f"RandomizeEffortLimit: nothing limits the effort on joint {model.joint(joint).name!r}: give its "
                    "actuator an effort_limit (forcerange), or leave the joint out"
                )
        for field, place_of in ranges.items():
            if place_of:
                self._write_ranges(view, field, place_of, mask_E, drawn_EN)

    def _write_ranges(
        self,
        view: EnvView,
        field: str,
        place_of: dict[int, int],
        mask_E: Bool[Tensor, " E"],
        drawn_EN: Tensor,
    ) -> None:
        rows, names = list(place_of), [view.joints(self.joints).names[i] for i in place_of.values()]
        # The lower bound as a size, like the upper one.
        own = getattr(view.world.mj_model, field)[rows] * np.array((-1.0, 1.0))
        check_not_negative(self, "ranges", names, own, self.ranges)
        own_N2 = array_constant(own, view.device)
        drawn_EN = drawn_EN[:, index_constant(list(place_of.values()), view.device)]
        size_EN2 = self.combine(own_N2, drawn_EN[..., None])
        signs_2 = constant((-1.0, 1.0), view.device)
        write_entries(view.field(field), rows, (0, 1), mask_E, size_EN2.expand(-1, -1, 2) * signs_2)


def check_not_negative(
    term: Randomize, field: str, names: Sequence[str], nominal: np.ndarray, pair: Pair
) -> None:
    """Refuse a range that could make a gain or a limit negative.

    Raises:
        ValueError: naming the field, the joint and the value.
    """
    low, _ = term.reach(nominal, pair)
    if np.any(low < 0.0):
        row = int(low.reshape(len(names), -1).min(-1).argmin())
        raise ValueError(
            f"{type(term).__name__}.{field}={pair!r}: that of joint {names[row]!r} would reach {low.min():g}; "
            "expected at least 0"
        )


def _actuators(mj_model: mujoco.MjModel, joint: int) -> list[int]:
    on_joints = np.isin(mj_model.actuator_trntype, _JOINT_TRANSMISSIONS)
    return [int(a) for a in np.flatnonzero(on_joints & (mj_model.actuator_trnid[:, 0] == joint))]


def _servo(mj_model: mujoco.MjModel, joint: int, gain: str) -> tuple[int, bool]:
    """Return the servo that has this gain, and whether the number is also its `gainprm[0]`.

    A position servo's bias is (0, -stiffness, -damping) with the gain stiffness, a velocity servo's (0, 0, -damping)
    with the gain damping.
    """
    position, velocity = None, None
    for actuator in _actuators(mj_model, joint):
        if (
            mj_model.actuator_gaintype[actuator] != mujoco.mjtGain.mjGAIN_FIXED
            or mj_model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_AFFINE
        ):
            continue
        force, bias = mj_model.actuator_gainprm[actuator, 0], mj_model.actuator_biasprm[actuator]
        if bias[1] == -force:
            position = actuator
        elif bias[1] == 0.0 and bias[2] == -force:
            velocity = actuator
    if gain == "damping" and velocity is not None:
        return velocity, True
    if position is not None:
        return position, gain == "stiffness"
    raise ValueError(
        f"RandomizeActuatorGains.{gain}: joint {mj_model.joint(joint).name!r} has no servo with this gain; expected a "
        "position or velocity actuator, or an explicit actuator"
    )
