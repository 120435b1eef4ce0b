"""These events draw what hinges and slides are made of, where they stand, and how they are read."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checks import check_choice
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import array_constant
from ksim_rl.mdp.fields import OfJoints
from ksim_rl.mdp.randomization.randomize import (
    Operation,
    Pair,
    RandomizeModelField,
    RandomizeNumber,
)
from ksim_rl.scene.names import Patterns, scalar_joint_ids


@dataclass(frozen=True, kw_only=True)
class RandomizeJointField(OfJoints, RandomizeModelField):
    """Draw entries of a field of hinges and slides per world."""

    kind: ClassVar[str] = "joint"

    @property
    def elements(self) -> Patterns:
        return self.joints

    def ids(self, view: EnvView) -> tuple[int, ...]:
        """Return the rows of the field: by joint, degree of freedom or generalized position, as its name says."""
        model = view.world.mj_model
        places = {"jnt": np.arange(model.njnt), "dof": model.jnt_dofadr, "qpos0": model.jnt_qposadr}
        scalar = scalar_joint_ids(model)
        joints = [scalar[i] for i in view.resolver.ids("joint", self.joints)]
        return tuple(int(i) for i in places[self.field.split("_")[0]][joints])


@dataclass(frozen=True, kw_only=True)
class RandomizeJointDamping(RandomizeJointField):
    """Viscous damping of joints, N m s / rad or N s / m."""

    field: ClassVar[str] = "dof_damping"
    lowest: ClassVar[float | None] = 0.0


@dataclass(frozen=True, kw_only=True)
class RandomizeJointArmature(RandomizeJointField):
    """Inertia that joints feel of their motors, kg m^2 or kg."""

    field: ClassVar[str] = "dof_armature"
    lowest: ClassVar[float | None] = 0.0


@dataclass(frozen=True, kw_only=True)
class RandomizeJointFrictionLoss(RandomizeJointField):
    """Dry friction of joints, N m or N."""

    field: ClassVar[str] = "dof_frictionloss"
    lowest: ClassVar[float | None] = 0.0


@dataclass(frozen=True, kw_only=True)
class RandomizeJointStiffness(RandomizeJointField):
    """Stiffness of the springs in joints, N m / rad or N / m; they pull towards the model's `springref`."""

    field: ClassVar[str] = "jnt_stiffness"
    lowest: ClassVar[float | None] = 0.0


@dataclass(frozen=True, kw_only=True)
class RandomizeJointRange(RandomizeJointField):
    """Limits of joints that have any, rad or m; columns: 0 lower, 1 upper.

    Soft limits, which rewards and resets use, stay those of the model's own range.
    """

    field: ClassVar[str] = "jnt_range"
    columns: ClassVar[int] = 2
    operation: Operation = "add"

    def _check_reach(self, view: EnvView, nominal: np.ndarray, pairs: Mapping[int, Pair]) -> None:
        lower = self.reach(nominal[:, 0], pairs[0])[1] if 0 in pairs else nominal[:, 0]
        upper = self.reach(nominal[:, 1], pairs[1])[0] if 1 in pairs else nominal[:, 1]
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
    """Where joints read zero displacement (MuJoCo's `qpos0`), rad or m: an error of assembly or calibration.

    At the same joint position the body stands elsewhere, by minus the change.
    """

    field: ClassVar[str] = "qpos0"
    operation: Operation = "add"


@dataclass(frozen=True, kw_only=True)
class RandomizeDefaultJointPos(OfJoints, RandomizeNumber):
    """The default pose, rad or m: what resets, position actions and relative joint positions start from.

    The model's own value is that of its first keyframe or, without one, `qpos0`. In mode "reset" let it run before the
    event that resets the joints.
    """

    operation: Operation = "add"

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        joints = view.joints(self.joints).index
        model = view.world.mj_model
        pose = model.key_qpos[0] if model.nkey else model.qpos0
        own = pose[model.jnt_qposadr[scalar_joint_ids(model)]]
        ids = view.resolver.ids("joint", self.joints)
        drawn_EN = self.draw(view, len(ids), [self.ranges])[..., 0]
        value_EN = self.combine(array_constant(own[list(ids)], view.device), drawn_EN)
        held_EN = view.default_joint_pos_EL[:, joints]
        view.default_joint_pos_EL[:, joints] = torch.where(mask_E[:, None], value_EN, held_EN)


@dataclass(frozen=True, kw_only=True)
class RandomizeEncoderBias(OfJoints, RandomizeNumber):
    """Offset between a joint's position and what its encoder reads, rad or m.

    Observations show it where they ask for it (`JointPosRel(biased=True)`); nothing else feels it.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("operation", self.operation, ("abs",))

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        joints = view.joints(self.joints).index
        held_EN = view.encoder_bias_EL[:, joints]
        drawn_EN = self.draw(view, held_EN.shape[1], [self.ranges])[..., 0]
        view.encoder_bias_EL[:, joints] = torch.where(mask_E[:, None], drawn_EN, held_EN)
