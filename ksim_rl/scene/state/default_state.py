"""Says in which state rows start before events draw: all that a model's first keyframe holds."""

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.scene.names import as_index, drives_scalar_joint
from ksim_rl.scene.state.joint_control import SMOOTHED, joint_control
from ksim_rl.scene.state.simulation import Simulation


class Held(NamedTuple):
    """Controls and activations of a model."""

    ctrl_L: np.ndarray
    act_L: np.ndarray


def held(mj_model: mujoco.MjModel, qpos_L: np.ndarray) -> Held:
    """Return controls of the servos of joints, and activations of all servos, that hold a pose; other zeros."""
    data = mujoco.MjData(mj_model)
    data.qpos[:] = qpos_L
    # Lengths of actuators at the pose need positions only, no velocities or forces.
    mujoco.mj_fwdPosition(mj_model, data)
    ctrl_L = np.zeros(mj_model.nu)
    act_L = np.zeros(mj_model.na)
    for actuator in range(mj_model.nu):
        on_joint = drives_scalar_joint(mj_model, actuator)
        on_tendon = mj_model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON
        control = joint_control(mj_model, actuator)
        # Efforts hold nothing by themselves; actuators of sites or bodies have no position to hold.
        if control.refusal or control.kind == "effort" or not (on_joint or on_tendon):
            continue
        # MuJoCo's length is gear * position.
        position = float(data.actuator_length[actuator] / mj_model.actuator_gear[actuator, 0])
        # Controls of tendons stay 0; only their activations follow.
        if on_joint:
            ctrl_L[actuator] = control.of(position if control.kind == "pos" else 0.0)
        # The activation at which the servo exerts nothing in this pose, kept inside of its range.
        if control.follows:
            resting = control.activation_scale * position + control.activation_offset
            low, high = activation_range(mj_model, actuator)
            act_L[activation_of(mj_model, actuator)] = min(max(resting, low), high)
    return Held(ctrl_L, act_L)


def default_data(mj_model: mujoco.MjModel) -> mujoco.MjData:
    """Return data at a model's first keyframe; without one at `qpos0`, held by the servos of its joints."""
    data = mujoco.MjData(mj_model)
    if mj_model.nkey:
        mujoco.mj_resetDataKeyframe(mj_model, data, 0)
        return data
    holding = held(mj_model, mj_model.qpos0)
    data.ctrl[:] = holding.ctrl_L
    data.act[:] = holding.act_L
    return data


def activation_of(mj_model: mujoco.MjModel, actuator: int) -> int:
    """Return where the activation of an actuator that has one stands, the last of several: MuJoCo's force reads it."""
    # MuJoCo numbers several activations of one actuator one after the other.
    return int(mj_model.actuator_actadr[actuator] + mj_model.actuator_actnum[actuator]) - 1


def activation_range(mj_model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """Return the lowest and highest activation that can last: its own range, for a filter the control's range too."""
    ranges = [(-np.inf, np.inf)]
    if mj_model.actuator_actlimited[actuator]:
        ranges.append(tuple(mj_model.actuator_actrange[actuator].tolist()))
    # A filter's activation moves towards its control, and cannot leave the control's range for long.
    is_filter = int(mj_model.actuator_dyntype[actuator]) in SMOOTHED
    if is_filter and mj_model.actuator_ctrllimited[actuator]:
        ranges.append(tuple(mj_model.actuator_ctrlrange[actuator].tolist()))
    # The ranges' intersection.
    highest_low = max(low for low, _ in ranges)
    lowest_high = min(high for _, high in ranges)
    return highest_low, lowest_high


class DefaultState:
    """The state in which rows start: the first keyframe, else `qpos0` at rest, held by the servos of its joints.

    Numbers are float64, in MuJoCo's layout and units; `mocap_pos_N3` and `mocap_quat_N4` are the poses of mocap bodies.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._device = simulation.device
        model = simulation.world.mj_model
        data = default_data(model)
        self.qpos_L = data.qpos.copy()
        self.qvel_L = data.qvel.copy()
        self.ctrl_L = data.ctrl.copy()
        self.act_L = data.act.copy()
        # A reset of the world leaves these at the numbers of `plain`.
        plain = mujoco.MjData(model)
        # Only fields that differ from a plain reset are restored, to save kernels at each reset.
        names = ("qpos", "qvel", "act", "mocap_pos", "mocap_quat")
        self._restored: dict[str, Tensor] = {}
        for name in names:
            start = getattr(data, name)
            if not np.array_equal(start, getattr(plain, name)):
                self._restored[name] = self._on_device(start)
        self._time = float(data.time)
        self._following = self._find_following()

    def _on_device(self, numbers: np.ndarray | list[float]) -> Tensor:
        return torch.tensor(numbers, device=self._device, dtype=torch.float32)

    def restore(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Write the state that the world's own reset has put elsewhere, in the rows of `mask_E`.

        Controls are not among it: `JointTargets` writes them.
        """
        world = self._simulation.world
        for name, start in self._restored.items():
            rows = mask_E.view(-1, *[1] * start.ndim)
            # Positions and velocities go through `write`, which marks derived quantities as stale.
            if name in ("qpos", "qvel"):
                if name == "qpos":
                    state_EL = world.qpos_EL
                else:
                    state_EL = world.qvel_EL
                self._simulation.write(state_EL, slice(None), mask_E, start.expand_as(state_EL))
                continue
            held_E = world.view(name)
            held_E.copy_(torch.where(rows, start, held_E))
        if self._time:
            world.time_E.masked_fill_(mask_E, self._time)

    def follow_pose(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Let the servos' activations follow joints of the rows of `mask_E` to where events have put them."""
        # No servo with an activation: nothing to do at resets.
        if self._following is None:
            return
        world = self._simulation.world
        following = self._following
        # How far events have moved each joint from the start.
        moved_EK = world.qpos_EL[:, following.qpos] - following.start_K
        # The activation moves along in proportion, so that the servo holds the new pose without a jump.
        resting_EK = following.act_K + following.scale_K * moved_EK
        resting_EK = torch.clamp(resting_EK, following.low_K, following.high_K)
        act_EK = world.act_EL[:, following.columns]
        world.act_EL[:, following.columns] = torch.where(mask_E[:, None], resting_EK, act_EK)

    def _find_following(self) -> "_Following | None":
        """Return the activations that follow joints; None if there is none."""
        model = self._simulation.world.mj_model
        columns: list[int] = []
        qpos: list[int] = []
        numbers: list[tuple[float, ...]] = []
        for actuator in range(model.nu):
            control = joint_control(model, actuator)
            # Tendons' activations have no single joint to follow.
            if control.refusal or not control.follows or not drives_scalar_joint(model, actuator):
                continue
            columns.append(activation_of(model, actuator))
            qpos.append(int(model.jnt_qposadr[model.actuator_trnid[actuator, 0]]))
            start = float(self.qpos_L[qpos[-1]])
            act = float(self.act_L[columns[-1]])
            low, high = activation_range(model, actuator)
            # At the default pose itself the keyframe's activation holds, even beyond its range.
            numbers.append((control.activation_scale, start, act, min(low, act), max(high, act)))
        if not columns:
            return None
        # One column per activation; rows: scale, start, activation, low, high, as `_Following` names them.
        table_NK = self._on_device(np.array(numbers).T)
        return _Following(as_index(columns, self._device), as_index(qpos, self._device), *table_NK)


class _Following(NamedTuple):
    """Which activations follow which positions, with both at the start, and between which numbers."""

    columns: slice | Tensor
    qpos: slice | Tensor
    scale_K: Tensor
    start_K: Tensor
    act_K: Tensor
    low_K: Tensor
    high_K: Tensor
