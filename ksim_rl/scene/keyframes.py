"""Edits the keyframes of specs: completes them, moves them with placed entities, and joins them."""

from collections.abc import Collection, Sequence

import mujoco
import numpy as np

from ksim_rl.physics import load_model
from ksim_rl.physics.load import caught_warnings
from ksim_rl.scene.state.default_state import held

_FIELDS = {
    "qpos": "qpos",
    "qvel": "qvel",
    "act": "act",
    "ctrl": "ctrl",
    "mpos": "mocap_pos",
    "mquat": "mocap_quat",
}
"""How a spec's keyframe and MuJoCo's data call what a keyframe holds."""


def complete_keyframes(spec: mujoco.MjSpec) -> None:
    """Let keyframes that say nothing of controls or activations hold their own poses by the servos of joints.

    MuJoCo would read zeros, which throw the joints to where servos have their zero.
    """
    # Without activations there is nothing that a keyframe could leave out of them.
    has_activations = any(
        actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE for actuator in spec.actuators
    )
    silent = [
        key for key in spec.keys if not len(key.ctrl) or (has_activations and not len(key.act))
    ]
    if not silent or not len(spec.actuators):
        return
    # The final compile of the spec passes the warnings on.
    with caught_warnings():
        mj_model = load_model(spec)
    for key in silent:
        # An empty qpos means the model's own pose.
        holding = held(mj_model, np.array(key.qpos) if len(key.qpos) else mj_model.qpos0)
        # Values that the keyframe has itself stay.
        if not len(key.ctrl):
            key.ctrl = holding.ctrl_L
        if mj_model.na and not len(key.act):
            key.act = holding.act_L


def compile_keyframes(spec: mujoco.MjSpec) -> None:
    """Compile a spec, so that its keyframes lose the numbers of elements that are deleted from it, and no others.

    Only of a spec that was compiled MuJoCo knows which number of a keyframe is whose.
    """
    with caught_warnings():
        spec.compile()


def let_new_servos_hold(spec: mujoco.MjSpec, new: Collection[str]) -> None:
    """Let the actuators that were added under these names hold the poses of keyframes that hold controls."""
    # Compiled keyframes are complete, also where the spec leaves numbers out.
    with caught_warnings():
        mj_model = spec.compile()
    columns = [i for i in range(mj_model.nu) if mj_model.actuator(i).name in new]
    for key, qpos in zip(spec.keys, mj_model.key_qpos, strict=True):
        # A keyframe without controls is completed as a whole later (`complete_keyframes`).
        if not len(key.ctrl):
            continue
        ctrl = np.array(key.ctrl)
        ctrl[columns] = held(mj_model, qpos).ctrl_L[columns]
        key.ctrl = ctrl


def move_keyframe(
    key: mujoco.MjsKey, mj_model: mujoco.MjModel, pos_3: Sequence[float], quat_4: Sequence[float]
) -> None:
    """Move a keyframe's poses of free joints and mocap bodies by a rigid transform: m, and a unit quaternion.

    Fields that it leaves out follow from the bodies, which have moved.
    """
    shift = np.array(pos_3)
    turn = np.array(quat_4)
    # Joints below a free root keep their numbers: these are relative.
    free = np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if len(key.qpos):
        qpos = np.array(key.qpos)
        for address in mj_model.jnt_qposadr[free]:
            pose = qpos[address : address + 7]
            pos = pose[:3].copy()
            quat = pose[3:].copy()
            # A copy of the pose goes in, since the result is written over it.
            mujoco.mju_mulPose(pose[:3], pose[3:], shift, turn, pos, quat)
        key.qpos = qpos
    if len(key.qvel):
        qvel = np.array(key.qvel)
        for address in mj_model.jnt_dofadr[free]:
            # The angular velocity is in the body's own frame, which has turned with it.
            linear = qvel[address : address + 3]
            mujoco.mju_rotVecQuat(linear, linear.copy(), turn)
        key.qvel = qvel
    if len(key.mpos):
        places = np.array(key.mpos).reshape(-1, 3)
        # World frame: turned, then shifted.
        for place in places:
            mujoco.mju_rotVecQuat(place, place.copy(), turn)
            place += shift
        key.mpos = places.ravel()
    if len(key.mquat):
        turns = np.array(key.mquat).reshape(-1, 4)
        for own in turns:
            # On the left: turned in the world.
            mujoco.mju_mulQuat(own, turn, own.copy())
        key.mquat = turns.ravel()


def add_joined(spec: mujoco.MjSpec, name: str, starts: Sequence[mujoco.MjData]) -> None:
    """Add one keyframe of the states of entities, in the order in which they were attached."""
    joined: dict[str, np.ndarray] = {}
    for attribute, field in _FIELDS.items():
        # Entities were attached one after the other, and so their numbers lie in the joined model.
        joined[attribute] = np.concatenate([getattr(start, field).ravel() for start in starts])
    spec.add_key(name=name, time=starts[0].time, **joined)
