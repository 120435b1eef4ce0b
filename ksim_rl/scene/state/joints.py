"""This module gives terms the hinges and slides that they name: `view.joints("hip.*").pos_EL`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.scene.names import as_index, scalar_joint_ids
from ksim_rl.scene.state.guarded_state import GuardedState
from ksim_rl.scene.state.quantity import quantity


class JointTables(NamedTuple):
    """What is known of all hinges and slides beyond their state; events may write it in place.

    default_pos_EL: rad or m; soft_limits_L2: the same, low and high; encoder_bias_EL: what encoders read too much.
    """

    default_pos_EL: Float[Tensor, "E L"]
    soft_limits_L2: Float[Tensor, "L 2"]
    encoder_bias_EL: Float[Tensor, "E L"]


class Joints:
    """The hinges (rad) and slides (m) that some patterns match, in the order of the patterns; L of them.

    Quantities are float32 and computed at most once per state, whoever reads them.

    Attributes:
        names: of the joints.
        ids: their places among the model's hinges and slides.
        index: the same, to index the L dim of a tensor over all hinges and slides: a slice, or int64 on the device.
    """

    def __init__(
        self,
        state: GuardedState,
        ids: Sequence[int],
        names: Sequence[str],
        tables: JointTables,
        every_joint: Joints | None = None,
    ) -> None:
        model, device = state.world.mj_model, state.world.device
        scalar = scalar_joint_ids(model)
        self.ids, self.names = tuple(ids), list(names)
        self.index = as_index(ids, device)
        self.cache = state.new_cache()
        self._state, self._tables, self._every_joint = state, tables, every_joint or self
        self._qpos = as_index([model.jnt_qposadr[scalar[i]] for i in ids], device)
        self._qvel = as_index([model.jnt_dofadr[scalar[i]] for i in ids], device)

    def __len__(self) -> int:
        return len(self.ids)

    def some(self, ids: Sequence[int]) -> Joints:
        """Return those at some places among the model's hinges and slides; for all joints only."""
        assert self is self._every_joint
        return Joints(self._state, ids, [self.names[i] for i in ids], self._tables, self)

    # -- state ---------------------------------------------------------------------------------------------------

    @quantity
    def pos_EL(self) -> Float[Tensor, "E L"]:
        """Positions, rad or m; position stage."""
        return self._state.world.qpos_EL[:, self._qpos]

    @quantity
    def vel_EL(self) -> Float[Tensor, "E L"]:
        """Velocities, rad/s or m/s; velocity stage."""
        return self._state.world.qvel_EL[:, self._qvel]

    @quantity
    def acc_EL(self) -> Float[Tensor, "E L"]:
        """Accelerations, rad/s^2 or m/s^2; acceleration stage."""
        return self._state.world.qacc_EL[:, self._qvel]

    @quantity
    def effort_EL(self) -> Float[Tensor, "E L"]:
        """What actuators exert, N m or N, behind the gears; acceleration stage."""
        return self._state.world.qfrc_actuator_EL[:, self._qvel]

    @quantity
    def pos_rel_EL(self) -> Float[Tensor, "E L"]:
        """Positions minus the default pose."""
        if self is self._every_joint:
            return self.pos_EL - self._tables.default_pos_EL
        return self._every_joint.pos_rel_EL[:, self.index]

    # -- what is known of them -------------------------------------------------------------------------------------

    @property
    def default_pos_EL(self) -> Float[Tensor, "E L"]:
        """Positions in the default pose, which events may move."""
        return self._tables.default_pos_EL[:, self.index]

    @property
    def soft_limits_L2(self) -> Float[Tensor, "L 2"]:
        """Low and high end of `scene.soft_joint_pos_limit_factor` of each range, infinite where there is none."""
        return self._tables.soft_limits_L2[self.index]

    @property
    def encoder_bias_EL(self) -> Float[Tensor, "E L"]:
        """What the encoders read beyond the position, rad or m."""
        return self._tables.encoder_bias_EL[:, self.index]

    # -- writes --------------------------------------------------------------------------------------------------

    def write_pos(self, mask_E: Bool[Tensor, " E"], pos_EL: Float[Tensor, "E L"]) -> None:
        """Set the positions in the rows of `mask_E`."""
        self._state.write_columns(self._state.world.qpos_EL, self._qpos, mask_E, pos_EL)

    def write_vel(self, mask_E: Bool[Tensor, " E"], vel_EL: Float[Tensor, "E L"]) -> None:
        """Set the velocities in the rows of `mask_E`."""
        self._state.write_columns(self._state.world.qvel_EL, self._qvel, mask_E, vel_EL)
