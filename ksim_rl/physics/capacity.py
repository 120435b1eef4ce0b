"""This module finds how many constraint rows and contacts a world needs, by a probe with MuJoCo's C engine."""

import copy
import hashlib
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from ksim_rl.physics.load import caught_warnings
from ksim_rl.physics.model_checks import model_bytes
from ksim_rl.physics.overflow import OF_POOL, OF_ROWS, OverflowReport
from ksim_rl.physics.sim_cfg import SimCfg

# On what the probe saw: half as much again for rows and contacts; less for candidate pairs, which all worlds share.
MARGIN = 1.5
PAIR_MARGIN = 1.2
EXTRA = 4
MULTIPLE = 8
RANDOM_STATES = 512
DROPS = 12
DROP_STEPS = 50
# How deep a dropped body may start in the ground, in m.
DEPTH = 0.02

# On what an env's rehearsal needed, which saw the env's own resets and actions.
REHEARSED_MARGIN = 1.25

_cache: dict[bytes, tuple[int, int]] = {}


def capacities(
    mj_model: mujoco.MjModel, sim: SimCfg, per_world_fields: Sequence[str] = ()
) -> tuple[int, int]:
    """Return (njmax, nconmax) per world: those of `sim`, or the probe's where they are None."""
    if sim.njmax is not None and sim.nconmax is not None:
        return sim.njmax, sim.nconmax
    njmax, nconmax = probe(_rubbing(mj_model, per_world_fields))
    return sim.njmax or njmax, sim.nconmax or nconmax


def is_certain(mj_model: mujoco.MjModel, sim: SimCfg, *, njmax: int) -> bool:
    """Whether `sim` gives both numbers, or no state has contacts or more rows than `njmax`."""
    if sim.njmax is not None and sim.nconmax is not None:
        return True
    if mj_model.nflex or CandidatePairs(mj_model).first.size:
        return False
    # Each degree of freedom and tendon may rub, and be at both ends of its range; a weld has six rows.
    most = 6 * mj_model.neq + 3 * (mj_model.nv + mj_model.ntendon)
    return most <= njmax


def remember(
    mj_model: mujoco.MjModel, sim: SimCfg, per_world_fields: Sequence[str], report: OverflowReport
) -> bool:
    """Let later `capacities` of this model have room for what worlds needed, where it was too little.

    Numbers that `sim` gives do not change. Returns whether others do.
    """
    probed = _rubbing(mj_model, per_world_fields)
    key = _key(probed)
    njmax, nconmax = probe(probed)
    wanted_njmax, wanted_nconmax = njmax, nconmax
    if sim.njmax is None and any(report.worlds[name] for name in OF_ROWS):
        needed = max(report.nefc, report.njmax)
        wanted_njmax = max(njmax, _round_up(REHEARSED_MARGIN * needed))
    if sim.nconmax is None and any(report.worlds[name] for name in OF_POOL):
        needed = max(report.ncon / report.num_envs, report.nconmax)
        wanted_nconmax = max(nconmax, _round_up(REHEARSED_MARGIN * needed))
    _cache[key] = (wanted_njmax, wanted_nconmax)
    return (wanted_njmax, wanted_nconmax) != (njmax, nconmax)


def _rubbing(mj_model: mujoco.MjModel, per_world_fields: Sequence[str]) -> mujoco.MjModel:
    """Return the model as worlds may be that differ in dry friction: each hinge, slide and tendon may have a row."""
    if not {"dof_frictionloss", "tendon_frictionloss"} & set(per_world_fields):
        return mj_model
    rubbing = copy.copy(mj_model)
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    scalar = np.isin(mj_model.jnt_type[mj_model.dof_jntid], kinds)
    rubbing.dof_frictionloss[scalar & (rubbing.dof_frictionloss == 0.0)] = 1e-3
    rubbing.tendon_frictionloss[rubbing.tendon_frictionloss == 0.0] = 1e-3
    return rubbing


def probe(mj_model: mujoco.MjModel) -> tuple[int, int]:
    """Return how many constraint rows and contacts a world of this model needs, with margin. Cached per model."""
    key = _key(mj_model)
    if key not in _cache:
        with caught_warnings():
            rows, contacts, pairs = _most(mj_model)
        nconmax = max(MARGIN * contacts, PAIR_MARGIN * pairs)
        _cache[key] = (_round_up(MARGIN * rows), _round_up(nconmax))
    return _cache[key]


def _key(mj_model: mujoco.MjModel) -> bytes:
    return hashlib.sha256(model_bytes(mj_model).tobytes()).digest()


def _round_up(needed: float) -> int:
    return MULTIPLE * math.ceil((needed + EXTRA) / MULTIPLE)


def _most(mj_model: mujoco.MjModel) -> tuple[int, int, int]:
    """Return the most constraint rows, contacts and candidate pairs of one world over many states."""
    rng = np.random.default_rng(0)
    mj_data = mujoco.MjData(mj_model)
    pairs = CandidatePairs(mj_model)
    most = np.zeros(3, dtype=int)

    def measure() -> None:
        np.maximum(most, (mj_data.nefc, mj_data.ncon, pairs.count(mj_data)), out=most)

    for key in range(-1, mj_model.nkey):
        mujoco.mj_resetData(mj_model, mj_data)
        if key >= 0:
            mujoco.mj_resetDataKeyframe(mj_model, mj_data, key)
        if np.isin(mujoco.mjtGeom.mjGEOM_HFIELD, mj_model.geom_type):
            # A height field may be above the pose, which the model has no way to know.
            put_in_ground(mj_model, mj_data, depth=0.0)
        mujoco.mj_fwdPosition(mj_model, mj_data)
        measure()
    for index, qpos in enumerate(random_qpos(mj_model, RANDOM_STATES, rng)):
        mujoco.mj_resetData(mj_model, mj_data)
        mj_data.qpos[:] = qpos
        scatter(mj_model, mj_data, rng)
        put_in_ground(mj_model, mj_data, depth=DEPTH * rng.random())
        mujoco.mj_fwdPosition(mj_model, mj_data)
        measure()
        if index < DROPS:
            mj_data.ctrl[:] = random_ctrl(mj_model, rng)
            for _ in range(DROP_STEPS):
                mujoco.mj_step(mj_model, mj_data)
                measure()
    return int(most[0]), int(most[1]), int(most[2])


def random_qpos(mj_model: mujoco.MjModel, num_states: int, rng: np.random.Generator) -> np.ndarray:
    """Draw poses [num_states, nq]: joints within their limits (else within a turn or a metre), any orientation."""
    qpos = np.tile(mj_model.qpos0, (num_states, 1))
    for joint in range(mj_model.njnt):
        adr, kind = int(mj_model.jnt_qposadr[joint]), mj_model.jnt_type[joint]
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            start = adr + 3 if kind == mujoco.mjtJoint.mjJNT_FREE else adr
            quat = rng.normal(size=(num_states, 4))
            qpos[:, start : start + 4] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        elif mj_model.jnt_limited[joint]:
            qpos[:, adr] = rng.uniform(*mj_model.jnt_range[joint], size=num_states)
        else:
            reach = math.pi if kind == mujoco.mjtJoint.mjJNT_HINGE else 1.0
            qpos[:, adr] += rng.uniform(-reach, reach, size=num_states)
    return qpos


def random_ctrl(mj_model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Draw controls [nu] within their ranges, else in [-1, 1]."""
    low = np.where(mj_model.actuator_ctrllimited, mj_model.actuator_ctrlrange[:, 0], -1.0)
    high = np.where(mj_model.actuator_ctrllimited, mj_model.actuator_ctrlrange[:, 1], 1.0)
    return rng.uniform(low, high)


def scatter(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Move free bodies to random places of the first height field, if there is one: its middle may be flat."""
    fields = np.flatnonzero(mj_model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)
    if fields.size == 0:
        return
    half = mj_model.hfield_size[mj_model.geom_dataid[fields[0]], :2]
    for joint in np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        address = mj_model.jnt_qposadr[joint]
        mj_data.qpos[address : address + 2] = rng.uniform(-0.9 * half, 0.9 * half)


def put_in_ground(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, *, depth: float) -> None:
    """Move each free body, with what hangs on it, so that one of its geoms is `depth` (m) deep in the ground.

    That is the highest plane, and the highest of the height field below a geom.
    """
    ground_types = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    free_joints = np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if not np.isin(mj_model.geom_type, ground_types).any() or free_joints.size == 0:
        return
    mujoco.mj_kinematics(mj_model, mj_data)
    depths = _ground_heights(mj_model, mj_data) - _lowest_points(mj_model, mj_data)
    roots = mj_model.body_rootid[mj_model.geom_bodyid]
    collides = (mj_model.geom_contype | mj_model.geom_conaffinity) != 0
    for joint in free_joints:
        geoms = collides & (roots == mj_model.body_rootid[mj_model.jnt_bodyid[joint]])
        deepest = depths[geoms].max(initial=-np.inf)
        if np.isfinite(deepest):
            mj_data.qpos[mj_model.jnt_qposadr[joint] + 2] += deepest - depth


def _ground_heights(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> np.ndarray:
    """Return the height of the ground below each geom (the highest of 9 points), m; -inf where there is none."""
    ground = np.full(mj_model.ngeom, -np.inf)
    planes = np.flatnonzero(mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    if planes.size:
        ground[:] = mj_data.geom_xpos[planes, 2].max()
    down = np.array([0.0, 0.0, -1.0])
    for field in np.flatnonzero(mj_model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD):
        above = mj_data.geom_xpos[field, 2] + mj_model.hfield_size[mj_model.geom_dataid[field], 2] + 1.0
        for geom, (x, y, _) in enumerate(mj_data.geom_xpos):
            reach = mj_model.geom_rbound[geom]
            for dx, dy in np.ndindex(3, 3):
                start = np.array([x + (dx - 1) * reach, y + (dy - 1) * reach, above])
                distance = mujoco.mj_rayHfield(mj_model, mj_data, int(field), start, down, None)
                if distance >= 0:
                    ground[geom] = max(ground[geom], above - distance)
    return ground


def _lowest_points(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> np.ndarray:
    """Return the height of each geom's lowest point, in m; for other than round geoms, that of its bounding box."""
    up = mj_data.geom_xmat.reshape(-1, 3, 3)[:, 2]
    center, half = mj_model.geom_aabb[:, :3], mj_model.geom_aabb[:, 3:]
    box = mj_data.geom_xpos[:, 2] + (up * center).sum(1) - (np.abs(up) * half).sum(1)
    radius = mj_model.geom_size[:, 0]
    length = np.where(mj_model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE, mj_model.geom_size[:, 1], 0.0)
    round_end = mj_data.geom_xpos[:, 2] - radius - np.abs(up[:, 2]) * length
    is_round = np.isin(mj_model.geom_type, (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE))
    return np.where(is_round, round_end, box)


class CandidatePairs:
    """Counts the geom pairs whose bounding spheres touch: Warp keeps a place in the contact pool for each of them.

    The pairs that may collide at all are those of MuJoCo's filters: contype and conaffinity, not the same rigid body,
    not parent and child, not excluded.
    """

    def __init__(self, mj_model: mujoco.MjModel) -> None:
        self.mj_model = mj_model
        first, second = np.triu_indices(mj_model.ngeom, k=1)
        body_1, body_2 = mj_model.geom_bodyid[first], mj_model.geom_bodyid[second]
        weld_1, weld_2 = mj_model.body_weldid[body_1], mj_model.body_weldid[body_2]
        parent_1 = mj_model.body_weldid[mj_model.body_parentid[weld_1]]
        parent_2 = mj_model.body_weldid[mj_model.body_parentid[weld_2]]
        affine = (mj_model.geom_contype[first] & mj_model.geom_conaffinity[second]) | (
            mj_model.geom_contype[second] & mj_model.geom_conaffinity[first]
        )
        keep = (affine != 0) & (weld_1 != weld_2)
        if not mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
            keep &= ~((weld_1 != 0) & (weld_2 != 0) & ((weld_1 == parent_2) | (weld_2 == parent_1)))
        keep &= ~np.isin((body_1 << 16) + body_2, mj_model.exclude_signature)
        self.first = np.concatenate([first[keep], mj_model.pair_geom1])
        self.second = np.concatenate([second[keep], mj_model.pair_geom2])
        self.margin = np.maximum(mj_model.geom_margin[self.first], mj_model.geom_margin[self.second])
        is_plane = mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self.plane_1, self.plane_2 = is_plane[self.first], is_plane[self.second]
        self.reach = mj_model.geom_rbound[self.first] + mj_model.geom_rbound[self.second] + self.margin

    def count(self, mj_data: mujoco.MjData) -> int:
        """Return the number of pairs that may touch in the present pose."""
        if self.first.size == 0:
            return 0
        offset = mj_data.geom_xpos[self.second] - mj_data.geom_xpos[self.first]
        distance = np.linalg.norm(offset, axis=1)
        normals = mj_data.geom_xmat[:, [2, 5, 8]]
        distance = np.where(self.plane_1, (offset * normals[self.first]).sum(1), distance)
        distance = np.where(self.plane_2, -(offset * normals[self.second]).sum(1), distance)
        return int(np.count_nonzero(distance <= self.reach))
