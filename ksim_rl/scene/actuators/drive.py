"""This module gives a law the joints that it computes, and its buffers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

from ksim_rl.scene.names import as_index, scalar_joint_ids
from ksim_rl.scene.state.joint_targets import JointState, JointTarget
from ksim_rl.scene.state.simulation import Simulation
from ksim_rl.scene.state.world_view import WorldView


class Drive:
    """The N joints of one law, in the model's order.

    Attributes:
        num_envs, num_joints, device: E, N, and where the buffers live.
    """

    def __init__(self, name: str, simulation: Simulation, view: WorldView, joint_ids: Sequence[int]) -> None:
        model = view.world.mj_model
        scalar = scalar_joint_ids(model)
        self.num_envs, self.num_joints, self.device = view.num_envs, len(joint_ids), view.device
        self._name, self._simulation, self._view = name, simulation, view
        self._joints = as_index(joint_ids, view.device)
        self._qpos = as_index([model.jnt_qposadr[scalar[i]] for i in joint_ids], view.device)
        self._qvel = as_index([model.jnt_dofadr[scalar[i]] for i in joint_ids], view.device)
        self._motors = as_index([view.targets.motor(i) for i in joint_ids], view.device)
        self._at_reset: list[Callable[[Bool[Tensor, " E"]], None]] = []

    def param(self, name: str) -> Float[Tensor, "E N"]:
        """Return the present values of a number of `Actuator.params`, [E, N]."""
        return self._view.actuator_param(name)[:, self._joints]

    def buffer(
        self, name: str, *shape: int, dtype: torch.dtype = torch.float32, keep: bool = False
    ) -> Shaped[Tensor, " E *shape"]:
        """Return a buffer [E, *shape] of the law; rows that reset are zeroed unless `keep`."""
        return self._view.buffers.get(f"{self._name}.{name}", *shape, dtype=dtype, keep=keep)

    def on_reset(self, draw: Callable[[Bool[Tensor, " E"]], None]) -> None:
        """Call `draw` with the mask of the rows that reset, bool [E]; it may draw by `integers`."""
        self._at_reset.append(draw)

    def integers(self, n: int, low: int, high: int) -> Int64[Tensor, "E L"]:
        """Draw int64 [E, n] from {low, ..., high}; the numbers depend on seed, law, env and count of resets only."""
        return self._view.integers(n, low, high)

    def reset(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw anew for the rows of `mask_E`."""
        if self._at_reset:
            with self._simulation.scope(self._name, self._view.reset_count_E, draws="reset"):
                for draw in self._at_reset:
                    draw(mask_E)

    def state(self) -> JointState:
        """Return where the joints are now, in the middle of an env step too."""
        world = self._view.world
        return JointState(world.qpos_EL[:, self._qpos], world.qvel_EL[:, self._qvel])

    def target(self) -> JointTarget:
        """Return what the joints are asked for."""
        targets, joints = self._view.targets, self._joints
        return JointTarget(targets.pos_EL[:, joints], targets.vel_EL[:, joints], targets.effort_EL[:, joints])

    def write(self, control_EN: Float[Tensor, "E N"]) -> None:
        """Set the controls of the motors."""
        self._view.world.ctrl_EL[:, self._motors] = control_EN
