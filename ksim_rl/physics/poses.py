"""Draws poses and controls of a model, and puts its bodies on the ground, for MuJoCo's C engine."""

import math

import mujoco
import numpy as np

# How far a ray goes on below what it does not stop at, in m.
BELOW = 1e-6


def random_qpos(mj_model: mujoco.MjModel, num_states: int, rng: np.random.Generator) -> np.ndarray:
    """Draw poses [num_states, nq]: joints within their limits (else within a turn or a metre), any orientation."""
    qpos = np.tile(mj_model.qpos0, (num_states, 1))
    for joint in range(mj_model.njnt):
        adr = int(mj_model.jnt_qposadr[joint])
        kind = mj_model.jnt_type[joint]
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                start = adr + 3
            else:
                start = adr
            # Gaussian quaternions, once normalized, are uniform over all orientations.
            quat = rng.normal(size=(num_states, 4))
            qpos[:, start : start + 4] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        elif mj_model.jnt_limited[joint]:
            # A hinge or slide with limits, rad or m.
            qpos[:, adr] = rng.uniform(*mj_model.jnt_range[joint], size=num_states)
        else:
            if kind == mujoco.mjtJoint.mjJNT_HINGE:
                reach = math.pi
            else:
                reach = 1.0
            qpos[:, adr] += rng.uniform(-reach, reach, size=num_states)
    return qpos


def random_ctrl(mj_model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Draw controls [nu] within their ranges, else in [-1, 1]."""
    low, high = _ctrl_ranges(mj_model)
    return rng.uniform(low, high)


def extreme_ctrl(mj_model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Draw controls [nu], each at one end of its range, else -1 or 1."""
    low, high = _ctrl_ranges(mj_model)
    return np.where(rng.random(mj_model.nu) < 0.5, low, high)


def _ctrl_ranges(mj_model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    low = np.where(mj_model.actuator_ctrllimited, mj_model.actuator_ctrlrange[:, 0], -1.0)
    high = np.where(mj_model.actuator_ctrllimited, mj_model.actuator_ctrlrange[:, 1], 1.0)
    return low, high


def scatter(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Move free bodies to random places of the first height field, if there is one: its middle may be flat."""
    fields = np.flatnonzero(mj_model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)
    if fields.size == 0:
        return
    # Half the width of the field along x and y, m, away from its rim.
    half = mj_model.hfield_size[mj_model.geom_dataid[fields[0]], :2]
    for joint in np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        address = mj_model.jnt_qposadr[joint]
        mj_data.qpos[address : address + 2] = rng.uniform(-0.9 * half, 0.9 * half)


def put_in_ground(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, *, depth: float) -> None:
    """Move each free body, with its subtree, so that one of its geoms is `depth` (m) deep in the ground.

    That is the highest plane, the highest of the height field below a geom, and everything else that is fixed to the
    world (boxes, meshes) below the body's origin.
    """
    free_joints = np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    is_solid = _solid_geoms(mj_model)
    if not is_solid.any() or free_joints.size == 0:
        return
    # Poses of geoms are needed before anything is moved.
    mujoco.mj_kinematics(mj_model, mj_data)
    ground = _ground_heights(mj_model, mj_data)
    lowest = _lowest_points(mj_model, mj_data)
    # All geoms of a tree move with its free joint.
    roots = mj_model.body_rootid[mj_model.geom_bodyid]
    collides = (mj_model.geom_contype | mj_model.geom_conaffinity) != 0
    for joint in free_joints:
        body = mj_model.jnt_bodyid[joint]
        geoms = collides & (roots == mj_model.body_rootid[body])
        top = _highest_solid(mj_model, mj_data, is_solid, mj_data.xpos[body])
        # For each geom of the tree, how deep it is in the ground below it.
        depths = np.maximum(ground[geoms], top) - lowest[geoms]
        deepest = depths.max(initial=-np.inf)
        # No ground lies below: the body stays where it is.
        if np.isfinite(deepest):
            mj_data.qpos[mj_model.jnt_qposadr[joint] + 2] += deepest - depth


def _solid_geoms(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return which geoms are fixed to the world and collide, bool [ngeom]."""
    is_fixed = mj_model.body_weldid[mj_model.geom_bodyid] == 0
    return is_fixed & ((mj_model.geom_contype | mj_model.geom_conaffinity) != 0)


def _highest_solid(
    mj_model: mujoco.MjModel, mj_data: mujoco.MjData, is_solid: np.ndarray, point: np.ndarray
) -> float:
    """Return the height of the highest solid geom above or below a point, m; -inf where there is none."""
    others = is_solid & (mj_model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    if not others.any():
        return -np.inf
    # A ray from above everything that is solid.
    highest = (mj_data.geom_xpos[others, 2] + mj_model.geom_rbound[others]).max() + 1.0
    start = np.array([point[0], point[1], highest])
    down = np.array([0.0, 0.0, -1.0])
    hit = np.zeros(1, dtype=np.int32)
    # Rays also hit geoms that move or do not collide: then they go on below.
    for _ in range(mj_model.ngeom):
        distance = mujoco.mj_ray(mj_model, mj_data, start, down, None, True, -1, hit)
        if distance < 0.0:
            break
        start[2] -= distance
        if others[hit[0]]:
            return float(start[2])
        start[2] -= BELOW
    return -np.inf


def _ground_heights(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> np.ndarray:
    """Return the height of the ground below each geom (the highest of 9 points), m; -inf where there is none."""
    ground = np.full(mj_model.ngeom, -np.inf)
    # Planes are taken as level: their height is their origin's.
    planes = np.flatnonzero(mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    if planes.size:
        ground[:] = mj_data.geom_xpos[planes, 2].max()
    down = np.array([0.0, 0.0, -1.0])
    for field in np.flatnonzero(mj_model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD):
        top = mj_model.hfield_size[mj_model.geom_dataid[field], 2]
        above = mj_data.geom_xpos[field, 2] + top + 1.0
        for geom, (x, y, _) in enumerate(mj_data.geom_xpos):
            # The centre of the square around the bounding sphere, its corners and the middles of its sides.
            reach = mj_model.geom_rbound[geom]
            for dx, dy in np.ndindex(3, 3):
                start = np.array([x + (dx - 1) * reach, y + (dy - 1) * reach, above])
                distance = mujoco.mj_rayHfield(mj_model, mj_data, int(field), start, down, None)
                if distance >= 0:
                    ground[geom] = max(ground[geom], above - distance)
    return ground


def _lowest_points(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> np.ndarray:
    """Return the height of each geom's lowest point, in m; of geoms that are not round, their bounding box's."""
    # The third row of a rotation matrix has the heights of its axes.
    up = mj_data.geom_xmat.reshape(-1, 3, 3)[:, 2]
    center = mj_model.geom_aabb[:, :3]
    half = mj_model.geom_aabb[:, 3:]
    height = mj_data.geom_xpos[:, 2]
    box = height + (up * center).sum(1) - (np.abs(up) * half).sum(1)
    is_sphere = mj_model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    is_capsule = mj_model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
    radius = mj_model.geom_size[:, 0]
    length = np.where(is_capsule, mj_model.geom_size[:, 1], 0.0)
    # A capsule's lower end is a half sphere around the end of its axis.
    round_end = height - radius - np.abs(up[:, 2]) * length
    is_round = is_sphere | is_capsule
    return np.where(is_round, round_end, box)
