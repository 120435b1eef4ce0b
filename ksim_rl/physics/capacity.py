"""Finds how many constraint rows and contacts a world needs, by a probe with MuJoCo's C engine."""

import copy
import hashlib
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from ksim_rl.physics.collision.candidate_pairs import CandidatePairs
from ksim_rl.physics.load import caught_warnings
from ksim_rl.physics.model_checks import model_bytes
from ksim_rl.physics.overflow import OF_POOL, OF_ROWS, OverflowReport
from ksim_rl.physics.poses import extreme_ctrl, put_in_ground, random_ctrl, random_qpos, scatter
from ksim_rl.physics.rows.idle_ties import FIXED_TIE, kinds_of_ties
from ksim_rl.physics.rows.tie_weights import rows_of_equalities
from ksim_rl.physics.sim_cfg import SimCfg

# On what poses of the probe needed: half as much again for rows and contacts, less for candidate pairs, which all
# worlds share. On what its falls needed, and an env's rehearsal: less, since these go on as an episode does.
MARGIN = 1.5
PAIR_MARGIN = 1.2
FALLS_MARGIN = REHEARSED_MARGIN = 1.25
EXTRA = 4
MULTIPLE = 8
# Rows that MuJoCo Warp takes together.
TILE = 16
RANDOM_STATES = 512
DROPS = 12
DROP_STEPS = 50
# How deep a dropped body may start in the ground, in m.
DEPTH = 0.02
# Falls, their steps, the steps between new controls, the speed at first (of each degree of freedom, rad/s or m/s), and
# how much heavier everything is in the second half.
FALLS = 24
FALL_STEPS = 200
HOLD = 10
FALL_SPEED = 1.0
PRESSURE = 3.0
# Degrees of freedom, geoms and vertices of flexes, times steps of all falls: about a second.
MOST_WORK = 1_200_000
MOST_ROWS = 2**31 - 1  # of an array of Warp

_cache: dict[bytes, tuple[int, int]] = {}


def capacities(
    mj_model: mujoco.MjModel, sim: SimCfg, per_world_fields: Sequence[str] = ()
) -> tuple[int, int]:
    """Return (njmax, nconmax) per world: as `sim` has them, or the probe's where they are None.

    The integrator "discrete" has room for whole tiles of rows, so that njmax may be up to 15 more.
    """
    njmax = sim.njmax
    nconmax = sim.nconmax
    # The probe takes about a second, and is left out where both numbers are given.
    if njmax is None or nconmax is None:
        probed_njmax, probed_nconmax = probe(_rubbing(mj_model, per_world_fields))
        # A number that is given stays, even if the other one is probed.
        njmax = njmax or probed_njmax
        nconmax = nconmax or probed_nconmax
    if mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE:
        # MuJoCo Warp regularizes rows up to the end of their last tile, and reads arrays there that end at njmax.
        njmax = TILE * math.ceil(njmax / TILE)
    return njmax, nconmax


def check_countable(njmax: int, nconmax: int, *, num_envs: int) -> None:
    """Refuse arrays longer than Warp can count: contacts of all worlds share one."""
    for name, number, worlds in (("njmax", njmax, 1), ("nconmax", nconmax, num_envs)):
        if number * worlds > MOST_ROWS:
            raise ValueError(
                f"sim.{name}={number}: expected at most {MOST_ROWS // worlds} for num_envs={num_envs}, as Warp counts "
                "the rows of an array in 32 bits; lower it, or num_envs"
            )


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
    """Let later `capacities` of this model have the room that worlds needed, where it was too little.

    Numbers that `sim` gives do not change. Returns whether others do.
    """
    probed = _rubbing(mj_model, per_world_fields)
    key = _key(probed)
    njmax, nconmax = probe(probed)
    wanted_njmax = njmax
    wanted_nconmax = nconmax
    # Only needs whose bits were raised count: the maxima alone may have fit.
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
    # Any positive value makes a row; how much it rubs does not matter for the count.
    rubbing = copy.copy(mj_model)
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    scalar = np.isin(mj_model.jnt_type[mj_model.dof_jntid], kinds)
    # Entries that rub already keep their value.
    rubbing.dof_frictionloss[scalar & (rubbing.dof_frictionloss == 0.0)] = 1e-3
    rubbing.tendon_frictionloss[rubbing.tendon_frictionloss == 0.0] = 1e-3
    return rubbing


def probe(mj_model: mujoco.MjModel) -> tuple[int, int]:
    """Return how many constraint rows and contacts a world of this model needs, with margin. Cached per model."""
    key = _key(mj_model)
    # The cache may hold more than a probe found: `remember` raises its numbers.
    if key not in _cache:
        # Random states make MuJoCo warn, which says nothing here.
        with caught_warnings():
            posed = Need(mj_model)
            fallen = Need(mj_model)
            _look_at_poses(mj_model, posed)
            _look_at_falls(mj_model, fallen)
        rows = max(
            MARGIN * posed.rows,
            FALLS_MARGIN * fallen.rows,
            # All limits together.
            max(posed.rows_without_limits, fallen.rows_without_limits) + _most_limits(mj_model),
        )
        nconmax = max(
            MARGIN * posed.contacts,
            FALLS_MARGIN * fallen.contacts,
            PAIR_MARGIN * posed.pairs,
            fallen.pairs,
        )
        _cache[key] = (_round_up(rows + _unseen_rows(mj_model)), _round_up(nconmax))
    return _cache[key]


def _key(mj_model: mujoco.MjModel) -> bytes:
    return hashlib.sha256(model_bytes(mj_model).tobytes()).digest()


def _round_up(needed: float) -> int:
    # A model without any contact or row so far has room for a few, too.
    return MULTIPLE * math.ceil((needed + EXTRA) / MULTIPLE)


def _most_limits(mj_model: mujoco.MjModel) -> int:
    """Return how many limits may have a row in one state: both of one joint where its range is within its margins."""
    joints = mj_model.jnt_limited.astype(bool)
    margin = mj_model.jnt_margin
    # Within twice the margin, a joint may violate both limits together.
    is_narrow = joints & (np.ptp(mj_model.jnt_range, axis=1) < 2.0 * margin)
    return int(joints.sum() + is_narrow.sum() + mj_model.tendon_limited.sum())


def _unseen_rows(mj_model: mujoco.MjModel) -> int:
    """Return how many rows of equality constraints worlds may have that C makes none of, so that no probe sees them.

    These are off at first and may be switched on, or they tie bodies that no joint moves: MuJoCo Warp makes rows for
    them.
    """
    is_unseen = (mj_model.eq_active0 == 0) | (kinds_of_ties(mj_model) == FIXED_TIE)
    return int(rows_of_equalities(mj_model)[is_unseen].sum())


class Need:
    """The most of everything that states of one world needed, of those that it was shown."""

    def __init__(self, mj_model: mujoco.MjModel) -> None:
        self._candidates = CandidatePairs(mj_model)
        self.rows = self.rows_without_limits = self.contacts = self.pairs = 0

    def look_at(self, mj_data: mujoco.MjData, *, pairs_too: bool = True) -> None:
        """Take in a state whose contacts and rows have been made; candidate pairs take the longest to count."""
        self.rows = max(self.rows, mj_data.nefc)
        self.rows_without_limits = max(self.rows_without_limits, mj_data.nefc - mj_data.nl)
        self.contacts = max(self.contacts, mj_data.ncon)
        if pairs_too:
            self.pairs = max(self.pairs, self._candidates.count(mj_data))


def _look_at_poses(mj_model: mujoco.MjModel, need: Need) -> None:
    """Show the model's own poses, and random ones in the ground; a few of these are simulated further."""
    # A fixed seed, so that a model has the same capacity in every process.
    rng = np.random.default_rng(0)
    mj_data = mujoco.MjData(mj_model)
    # Key -1 is the model's own pose, qpos0.
    for key in range(-1, mj_model.nkey):
        _put_to_key(mj_model, mj_data, key)
        if np.isin(mujoco.mjtGeom.mjGEOM_HFIELD, mj_model.geom_type):
            # A height field may be above the pose, which the model has no way to know.
            put_in_ground(mj_model, mj_data, depth=0.0)
        mujoco.mj_fwdPosition(mj_model, mj_data)
        need.look_at(mj_data)
    for index, qpos in enumerate(random_qpos(mj_model, RANDOM_STATES, rng)):
        mujoco.mj_resetData(mj_model, mj_data)
        mj_data.qpos[:] = qpos
        # The middle of a height field may be flat, and would show too few contacts.
        scatter(mj_model, mj_data, rng)
        put_in_ground(mj_model, mj_data, depth=DEPTH * rng.random())
        mujoco.mj_fwdPosition(mj_model, mj_data)
        need.look_at(mj_data)
        # A few go on as a simulation does: contacts of a first impact and after it.
        if index < DROPS:
            mj_data.ctrl[:] = random_ctrl(mj_model, rng)
            for _ in range(DROP_STEPS):
                mujoco.mj_step(mj_model, mj_data)
                need.look_at(mj_data)


def _look_at_falls(mj_model: mujoco.MjModel, need: Need) -> None:
    """Show how the model falls and lies, from its own poses and from random ones, limp, at random and with all force.

    In the second half of a fall it is pressed on the ground, and against its limits.
    """
    rng = np.random.default_rng(1)
    mj_data = mujoco.MjData(mj_model)
    # More gravity presses bodies on the ground and against their limits, which closes more contacts.
    heavy = copy.copy(mj_model)
    heavy.opt.gravity *= PRESSURE
    # The size of the moving part, m, bounds the height of the fall.
    is_moving = mj_model.body_weldid[mj_model.geom_bodyid] != 0
    mujoco.mj_kinematics(mj_model, mj_data)
    if is_moving.any():
        size = float(np.ptp(mj_data.geom_xpos[is_moving], axis=0).max(initial=0.0))
    else:
        size = 0.0
    # Large models fall for fewer steps, so that the probe takes about a second for each.
    work = mj_model.nv + mj_model.ngeom + mj_model.nflexvert + 1
    steps = min(FALL_STEPS, max(1, MOST_WORK // (FALLS * work)))
    for index, qpos in enumerate(random_qpos(mj_model, FALLS, rng)):
        # Every other fall starts from one of the model's own poses.
        if index % 2:
            mujoco.mj_resetData(mj_model, mj_data)
            mj_data.qpos[:] = qpos
        else:
            _put_to_key(mj_model, mj_data, index // 2 % (mj_model.nkey + 1) - 1)
        scatter(mj_model, mj_data, rng)
        put_in_ground(mj_model, mj_data, depth=-rng.uniform(0.0, size))
        mj_data.qvel[:] = rng.normal(scale=FALL_SPEED, size=mj_model.nv)
        # In turn: no control, random control, the extremes of control.
        draw = (None, random_ctrl, extreme_ctrl)[index // 2 % 3]
        for step in range(steps):
            if draw is not None and step % HOLD == 0:
                mj_data.ctrl[:] = draw(mj_model, rng)
            mujoco.mj_step(mj_model if step < steps // 2 else heavy, mj_data)
            # MuJoCo has reset a state that diverged: this fall is over.
            if mj_data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
                break
            need.look_at(mj_data, pairs_too=step % HOLD == 0)


def _put_to_key(mj_model: mujoco.MjModel, mj_data: mujoco.MjData, key: int) -> None:
    """Put the data to a keyframe, or to the model's own pose for -1."""
    mujoco.mj_resetData(mj_model, mj_data)
    if key >= 0:
        mujoco.mj_resetDataKeyframe(mj_model, mj_data, key)
