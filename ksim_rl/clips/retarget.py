"""Lets a robot follow recorded points: pairs say which part of the robot follows which point."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.checked import Checked, NonNegative, Positive
from ksim_rl.checks import near
from ksim_rl.clips.inverse_kinematics import InverseKinematics, PoseGoal
from ksim_rl.clips.recording import Array, Recording, multiply
from ksim_rl.config.config_tree import from_tree
from ksim_rl.config.plain_data import read_yaml
from ksim_rl.scene.motions.frames import in_each_frame


@dataclass(frozen=True, kw_only=True)
class Pair(Checked):
    """A site or body of the robot that goes where a point of the recording goes.

    Attributes:
        point: its name in the recording.
        to: the site's or body's name.
        weight: cost of 1 m of error.
        turn_weight: cost of 1 rad of error; 0 leaves the part's orientation open.
        quat: the rotation (w, x, y, z) from the point's frame to the part's, where both do the same.
    """

    point: str
    to: str
    weight: NonNegative = 1.0
    turn_weight: NonNegative = 0.0
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Retarget(Checked):
    """How a recording becomes a robot's motion.

    Attributes:
        scale: m of the robot per m of the recording; its legs relative to the person's.
        posture_weight: cost of 1 rad from the default pose, for joints that no pair asks for.
        stride_weight: cost of 1 rad from the frame before: it keeps the motion continuous.
        soles: sites or bodies that touch the ground in the lowest frames: the motion is lowered or raised by a constant
            so that the fifth percentile of their lowest height is `sole_z` (m); () leaves heights as they are.
    """

    pairs: tuple[Pair, ...]
    scale: Positive = 1.0
    posture_weight: NonNegative = 0.02
    stride_weight: NonNegative = 0.05
    soles: tuple[str, ...] = ()
    sole_z: float = 0.0

    def _check_fields(self) -> None:
        super()._check_fields()
        if not self.pairs:
            raise ValueError(
                "pairs=(): expected at least one pair of a point and a part of the robot"
            )


def read_retarget(path: Path) -> Retarget:
    """Read a YAML file with the fields of `Retarget`."""
    tree = read_yaml(path)
    if not isinstance(tree, dict):
        raise ValueError(
            f"{path}: expected a mapping with `pairs`, a list of {{point: ..., to: ...}}"
        )
    return from_tree(Retarget, tree, str(path))


def retargeted(
    recording: Recording, mj_model: mujoco.MjModel, cfg: Retarget, *, fps: float = 50.0
) -> Float[Array, "F L"]:
    """Return the qpos of a robot that moves as a recording does, at `fps` frames per second.

    The model has a free root. Each frame is searched for from the frame before, within the joints' ranges. A ValueError
    names the point, site or body that does not exist.
    """
    # Names are checked before minutes of searching.
    for pair in cfg.pairs:
        if pair.point not in recording.names:
            raise ValueError(
                f"the recording has no point {pair.point!r}: {near(pair.point, recording.names)}"
            )
    solver = InverseKinematics(mj_model)
    solver.check_names([*(pair.to for pair in cfg.pairs), *cfg.soles])
    # At the robot's control rate first, so that no pose has to be interpolated between joints.
    played = recording.resampled(fps)
    # The pose that no pair disagrees with, such as the keyframe "home".
    rest_L = (mj_model.key_qpos[0] if mj_model.nkey else mj_model.qpos0).copy()
    pull_M = np.full(mj_model.nv, cfg.posture_weight)
    # The root goes wherever the pairs take it.
    pull_M[:6] = 0.0
    # Two pulls on one coordinate are one, to the weighted mean of where they pull to.
    both_M = np.hypot(pull_M, cfg.stride_weight)
    share_M = (pull_M / np.maximum(both_M, 1e-12)) ** 2
    found: list[Array] = []
    for frame in range(len(played.pos_FN3)):
        goals = _goals(played, cfg, frame)
        if not found:
            # The first frame has none before it, and may be far from the default pose.
            # Near to the person and turned as the person is: a search from afar may end in another pose.
            start_L = _facing(rest_L, goals[0])
            patient = InverseKinematics(mj_model, replace(solver.cfg, iterations=400))
            found.append(
                patient.solve(goals, start_L=start_L, posture_L=start_L, posture_weight_M=pull_M)
            )
            continue
        # Towards the default pose, as far as its weight against the stride's says.
        aim_L = _between(mj_model, found[-1], rest_L, share_M)
        found.append(
            solver.solve(goals, start_L=found[-1], posture_L=aim_L, posture_weight_M=both_M)
        )
    qpos_FL = np.array(found)
    if cfg.soles:
        # One constant for all frames: jumps stay jumps.
        qpos_FL[:, 2] += cfg.sole_z - _low_height(mj_model, qpos_FL, cfg.soles)
    return qpos_FL


def _goals(played: Recording, cfg: Retarget, frame: int) -> list[PoseGoal]:
    goals: list[PoseGoal] = []
    for pair in cfg.pairs:
        point = played.names.index(pair.point)
        if pair.turn_weight:
            # The part's frame differs from the point's by a fixed rotation.
            quat_4 = multiply(played.quat_FN4[frame, point], np.array(pair.quat))
        else:
            quat_4 = None
        goals.append(
            PoseGoal(
                name=pair.to,
                pos_3=cfg.scale * played.pos_FN3[frame, point],
                quat_4=quat_4,
                weight=pair.weight,
                turn_weight=pair.turn_weight,
            )
        )
    return goals


def _facing(rest_L: Array, first: PoseGoal) -> Array:
    """Return the default pose with the root where the first pair's part should be, and with its heading."""
    start_L = rest_L.copy()
    start_L[:3] = first.pos_3
    if first.quat_4 is not None:
        w, x, y, z = first.quat_4
        # Yaw of the quaternion; roll and pitch are left out, so that the robot starts upright.
        heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        half = heading / 2
        turn_4 = np.array((np.cos(half), 0.0, 0.0, np.sin(half)))
        start_L[3:7] = multiply(turn_4, rest_L[3:7])
    return start_L


def _between(mj_model: mujoco.MjModel, from_L: Array, to_L: Array, share_M: Array) -> Array:
    """Return the qpos that lies part of the way from one to another, by a share for each degree of freedom."""
    way_M = np.zeros(mj_model.nv)
    between_L = from_L.copy()
    # In the tangent space, where a share of a rotation is well defined.
    mujoco.mj_differentiatePos(mj_model, way_M, 1.0, from_L, to_L)
    mujoco.mj_integratePos(mj_model, between_L, way_M * share_M, 1.0)
    return between_L


def _low_height(mj_model: mujoco.MjModel, qpos_FL: Array, soles: Sequence[str]) -> float:
    lowest = []
    sites = {mj_model.site(i).name for i in range(mj_model.nsite)}
    for data in in_each_frame(mj_model, qpos_FL):
        heights = []
        for name in soles:
            if name in sites:
                sole = data.site(name)
            else:
                sole = data.body(name)
            heights.append(sole.xpos[2])
        lowest.append(min(heights))
    # Not the minimum: a few frames of noise below the ground would lift the whole motion.
    return float(np.percentile(lowest, 5.0))
