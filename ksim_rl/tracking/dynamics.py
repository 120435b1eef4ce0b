"""Computes the demands of a motion on a robot: torques, the ground's push, and contacts of the robot with itself.

MuJoCo's inverse dynamics (`mj_inverse` without contacts) gives the wrench that the ground must exert on the floating
root, and the joint torques beside it. Wrenches of two feet that stand are shared by where the zero-moment point lies
between them, as Vukobratovic ("Zero-moment point: thirty-five years of its life", 2004) describes it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from ksim_rl.clips.motion_file import velocities

Array = np.ndarray
GRAVITY = 9.81


@dataclass(frozen=True, kw_only=True)
class Demand:
    """The demands of each of F frames on robot and ground.

    Attributes:
        zmp_F2: the zero-moment point on what is stood on, m: where the ground's pressure must have its centre.
        com_F3: the centre of mass, m.
        force_F3: of the ground on the robot, N.
        torque_FM: of the joints, N m, one column per degree of freedom behind the six of the root.
    """

    zmp_F2: Float[Array, "F 2"]
    com_F3: Float[Array, "F 3"]
    force_F3: Float[Array, "F 3"]
    torque_FM: Float[Array, "F M"]


def demand(
    mj_model: mujoco.MjModel,
    qpos_FL: Float[Array, "F L"],
    fps: float,
    *,
    feet: Sequence[str],
    planted_FN: Bool[Array, "F N"],
    level_FN: Float[Array, "F N"] | None = None,
) -> Demand:
    """Return the demands of a motion of a robot with a free root.

    `feet` are sites at the middles of the soles, `planted_FN` which of them stand, and `level_FN` on what height, m
    (None: all on the ground). Between feet of two heights the zero-moment point is on the line from one to the other.
    The robot is alone in its model.
    """
    if level_FN is None:
        level_FN = np.zeros(planted_FN.shape)
    qvel_FM = velocities(mj_model, qpos_FL, fps)
    # Differences of the motion: mj_inverse needs the acceleration of each frame.
    qacc_FM = np.gradient(qvel_FM, 1.0 / fps, axis=0)
    model = mj_model
    data = mujoco.MjData(mj_model)
    # Without contacts and constraints the root's wrench is all that the ground has to give.
    flags = model.opt.disableflags
    model_flags = mujoco.mjtDisableBit
    model.opt.disableflags |= int(model_flags.mjDSBL_CONTACT) | int(model_flags.mjDSBL_CONSTRAINT)
    zmp = []
    com = []
    force = []
    torque = []
    try:
        for qpos, qvel, qacc, planted, level in zip(
            qpos_FL, qvel_FM, qacc_FM, planted_FN, level_FN, strict=True
        ):
            data.qpos[:] = qpos
            data.qvel[:] = qvel
            data.qacc[:] = qacc
            # Generalized forces that produce this acceleration, with the root's wrench.
            mujoco.mj_inverse(model, data)
            force_3, zmp_2, spin = _ground_wrench(data, _standing(data, feet, planted, level))
            zmp.append(zmp_2)
            com.append(data.subtree_com[0].copy())
            force.append(force_3)
            torque.append(_joint_torques(model, data, feet, planted, level, force_3, zmp_2, spin))
    finally:
        # The model belongs to the caller.
        model.opt.disableflags = flags
    return Demand(
        zmp_F2=np.array(zmp),
        com_F3=np.array(com),
        force_F3=np.array(force),
        torque_FM=np.array(torque),
    )


def _standing(data: mujoco.MjData, feet: Sequence[str], planted_N: Array, level_N: Array) -> Array:
    """Return where the feet stand, m: x and y of the sites, and the height of what is below them, [N, 3]."""
    places = []
    for foot, is_planted, level in zip(feet, planted_N, level_N, strict=True):
        if is_planted:
            places.append((*data.site(foot).xpos[:2], level))
    return np.array(places).reshape(-1, 3)


def _ground_wrench(data: mujoco.MjData, places_N3: Array) -> tuple[Array, Array, float]:
    """Return the ground's force, the point on what is stood on about which its moment is vertical, and that moment.

    Without places it is a point at z = 0.
    """
    # Force in world axes, moment in the root's own: a free joint's convention in MuJoCo.
    force_3 = data.qfrc_inverse[:3].copy()
    moment_3 = np.empty(3)
    mujoco.mju_rotVecQuat(moment_3, data.qfrc_inverse[3:6], data.qpos[3:7])
    # Moved from the root to the origin of the world.
    about_origin_3 = moment_3 + np.cross(data.qpos[:3], force_3)
    # The root's wrench belongs to the ground: p x f with p on the ground has these horizontal moments.
    on_floor_2 = np.array((-about_origin_3[1], about_origin_3[0])) / force_3[2]
    zmp_2 = on_floor_2
    # The point moves along the force with the height, which depends on where between the feet it is.
    for _ in range(4 if places_N3[:, 2].any() else 0):
        height = float(_shares(places_N3, zmp_2) @ places_N3[:, 2])
        zmp_2 = on_floor_2 + height * force_3[:2] / force_3[2]
    # The moment about the vertical, which friction of the soles has to hold.
    spin = about_origin_3[2] - (zmp_2[0] * force_3[1] - zmp_2[1] * force_3[0])
    return force_3, zmp_2, float(spin)


def _shares(places_N3: Array, zmp_2: Array) -> Array:
    """Return the shares of one or two feet in the force: two share it as a lever does, by where the pressure is."""
    if len(places_N3) == 1:
        return np.array([1.0])
    line_2 = places_N3[1, :2] - places_N3[0, :2]
    from_first_2 = zmp_2 - places_N3[0, :2]
    second = np.clip(from_first_2 @ line_2 / (line_2 @ line_2), 0.0, 1.0)
    return np.array([1.0 - second, second])


def _joint_torques(
    mj_model: mujoco.MjModel,
    data: mujoco.MjData,
    feet: Sequence[str],
    planted_N: Array,
    level_N: Array,
    force_3: Array,
    zmp_2: Array,
    spin: float,
) -> Array:
    standing = [foot for foot, is_planted in zip(feet, planted_N, strict=True) if is_planted]
    # In flight nothing pushes, so nothing has to be taken off.
    if not standing:
        return data.qfrc_inverse[6:].copy()
    places_N3 = _standing(data, feet, planted_N, level_N)
    shares = _shares(places_N3, zmp_2)
    # Pressure that is not on that line is beside both feet alike.
    beside_2 = zmp_2 - shares @ places_N3[:, :2]
    torque_M = data.qfrc_inverse.copy()
    jacobian_3M = np.zeros((3, mj_model.nv))
    turn_3M = np.zeros((3, mj_model.nv))
    for foot, place_3, share in zip(standing, places_N3, shares, strict=True):
        # On the ground, below the sole.
        point_3 = np.append(place_3[:2] + beside_2, place_3[2])
        mujoco.mj_jac(
            mj_model, data, jacobian_3M, turn_3M, point_3, int(mj_model.site(foot).bodyid[0])
        )
        # Take off the joint torques that the ground's push on this foot already gives.
        torque_M -= share * (jacobian_3M.T @ force_3 + turn_3M[2] * spin)
    return torque_M[6:]


def self_contacts(mj_model: mujoco.MjModel, qpos_FL: Float[Array, "F L"]) -> list[str]:
    """Return which geoms of a robot that is alone in its model run into each other, and in which frame first."""
    data = mujoco.MjData(mj_model)
    found = {}
    for frame, qpos in enumerate(qpos_FL):
        data.qpos[:] = qpos
        # Positions alone find contacts.
        mujoco.mj_fwdPosition(mj_model, data)
        for contact in data.contact[: data.ncon]:
            names = [mj_model.geom(int(geom)).name for geom in contact.geom]
            # Positive distances are within the margin, but do not touch.
            if contact.dist < 0.0:
                # The first frame of each pair is kept.
                found.setdefault(" and ".join(sorted(names)), frame)
    return [f"{pair} from frame {frame} on" for pair, frame in found.items()]
