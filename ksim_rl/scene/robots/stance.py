"""Makes robots stand: finds a pose with the centre of mass over the soles, and holds it in C."""

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import minimize

from ksim_rl.physics import SimCfg
from ksim_rl.scene.names import SCALAR_JOINTS
from ksim_rl.scene.robots.anatomy import Leg, posed
from ksim_rl.scene.terrains import PlaneTerrain

SIM = SimCfg(
    timestep=0.005, integrator="implicitfast", solver="newton", iterations=10, ls_iterations=20
)
"""The physics of the velocity tasks."""
OTHER_CONSTRAINTS = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_LIMIT
    | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
)
BEND = np.array([-0.4, 0.8, -0.4])
"""rad about y by which hip, knee and ankle of straight legs are bent at first."""


def find_stance(
    mj_model: mujoco.MjModel,
    legs: Sequence[Leg],
    qpos: np.ndarray,
    *,
    passive: Collection[int] = (),
) -> np.ndarray:
    """Return the pose near `qpos` in which all soles are flat on z = 0 with the centre of mass above their middle.

    Inverse kinematics: a least-squares problem in the root's height and the joints of the legs, inside 90 % of their
    ranges. Straight legs are bent, with the knees forward on two legs; others keep their crouch. Springs, which are
    `passive` joints, keep their length; rods of closed chains move with the rest, and hold together.
    """
    data = posed(mj_model, qpos)
    # The free joint has the lowest type, 0.
    root = int(mj_model.jnt_type.argmin())
    first = int(mj_model.jnt_qposadr[root])
    # None for plain trees, which need no constraints.
    closed = _closed_chains(mj_model)
    # Each joint once: legs may share some.
    of_legs = dict.fromkeys(joint for leg in legs for joint in leg.joints)
    # Passive joints without a spring follow the loop that they close; springs keep their length.
    rods = [
        joint for joint in passive if closed is not None and mj_model.jnt_stiffness[joint] == 0.0
    ]
    joints = [
        joint
        for joint in of_legs
        if joint not in passive and int(mj_model.jnt_type[joint]) in SCALAR_JOINTS
    ]
    joints += [joint for joint in rods if joint not in joints]
    # The unknowns: the root's height, then the joints.
    columns = [first + 2, *mj_model.jnt_qposadr[joints]]
    # Where each foot stands now, x and y, so that the stance does not move feet about.
    given = [leg.points(data).mean(0)[:2] for leg in legs]
    # Straight legs are singular: no bend, no way up or down.
    for leg in legs:
        pitch = {joint: sign for joint, sign in leg.pitch_joints(data).items() if joint in joints}
        angles = data.qpos[mj_model.jnt_qposadr[list(pitch)]]
        # Below 0.2 rad at all pitch joints a leg counts as straight.
        if len(pitch) > 1 and np.abs(angles).max() < 0.2:
            # Knees forward for two legs; the other way for more.
            bend = BEND[: len(pitch)] * (1.0 if len(legs) == 2 else -1.0)
            lowest_joints = list(pitch.items())[-3:]
            for (joint, sign), turn in zip(lowest_joints, bend, strict=False):
                data.qpos[mj_model.jnt_qposadr[joint]] += sign * turn
    # Unlimited joints may go half a turn each way.
    is_limited = mj_model.jnt_limited[joints]
    limits = np.where(is_limited[:, None], mj_model.jnt_range[joints], [-np.pi, np.pi])
    # A margin of 5 % at each end of the ranges.
    low = limits @ [0.95, 0.05]
    high = limits @ [0.05, 0.95]
    data.qpos[columns[1:]] = np.clip(data.qpos[columns[1:]], low, high)
    mujoco.mj_kinematics(mj_model, data)
    # Down, until the lowest point touches z = 0.
    data.qpos[columns[0]] -= min(leg.points(data)[:, 2].min() for leg in legs)
    wanted = data.qpos[columns].copy()

    # Residuals, each in units of its tolerance.
    def misses(x: np.ndarray) -> np.ndarray:
        data.qpos[columns] = x
        mujoco.mj_kinematics(mj_model, data)
        mujoco.mj_comPos(mj_model, data)
        soles = [leg.points(data) for leg in legs]
        middles = np.array([points.mean(0)[:2] for points in soles])
        # Soles flat, m; balance, m; feet in place up to a common shift, m; near the start, m and rad.
        com = data.subtree_com[mj_model.jnt_bodyid[root]]
        shifts = middles - given
        tolerances = np.array([0.05, *[0.5] * len(joints)])
        parts = (
            np.concatenate(soles)[:, 2] / 0.001,
            (com[:2] - middles.mean(0)) / 0.002,
            (shifts - shifts.mean(0)).ravel() / 0.02,
            (x - wanted) / tolerances,
        )
        if closed is None:
            return np.concatenate(parts)
        # Loops must close as well: `efc_pos` of equalities is their gap.
        mujoco.mj_fwdPosition(closed, data)
        return np.concatenate((*parts, data.efc_pos[: data.ne] / 0.001))

    # The root may move by a metre up or down.
    lowest = np.array([[wanted[0] - 1.0, *low]]).T
    highest = np.array([[wanted[0] + 1.0, *high]]).T
    x, _ = minimize.least_squares(
        wanted[:, None],
        # The solver asks for several points in one call, as columns.
        lambda x_LK: np.stack([misses(x) for x in x_LK.T], axis=-1),
        bounds=[lowest, highest],
        verbose=0,
    )
    data.qpos[columns] = x.ravel()
    # The horizontal place of the root is free: it stands over the origin.
    data.qpos[first : first + 2] = 0.0
    return data.qpos.copy()


def _closed_chains(mj_model: mujoco.MjModel) -> mujoco.MjModel | None:
    """Return a model whose only constraints hold chains together, or None where there are none."""
    if not mj_model.neq:
        return None
    closed = copy.copy(mj_model)
    closed.opt.disableflags |= OTHER_CONSTRAINTS
    return closed


class Standing(NamedTuple):
    """How a robot stands whose servos hold its keyframe, without a policy."""

    seconds: float
    """Until it tilts by 45 degrees or sinks to 60 % of its height, or the whole trial."""
    sag: Mapping[str, float]
    """How far driven joints are from their targets at the end, rad, by name."""
    drift: float
    """Of the root along the ground, m."""


def on_plane(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the model of a robot on a plane, with the physics of the velocity tasks."""
    spec = spec.copy()
    PlaneTerrain().add_to(spec)
    SIM.apply_to(spec)
    return spec.compile()


def stand(mj_model: mujoco.MjModel, *, seconds: float = 5.0) -> Standing:
    """Hold the keyframe for some seconds in MuJoCo's C engine."""
    data = mujoco.MjData(mj_model)
    mujoco.mj_resetDataKeyframe(mj_model, data, 0)
    mujoco.mj_kinematics(mj_model, data)
    root = int(mj_model.jnt_type.argmin())
    body = int(mj_model.jnt_bodyid[root])
    first = int(mj_model.jnt_qposadr[root])
    start = data.qpos[first : first + 3].copy()
    up = data.xmat[body, 6:].copy()  # in the body's frame, which need not stand upright itself
    fallen = False
    while data.time < seconds and not fallen:
        mujoco.mj_step(mj_model, data)
        sinks = data.qpos[first + 2] < 0.6 * start[2]
        # The cosine of 45 degrees, between the body's up now and at the start.
        fallen = sinks or data.xmat[body, 6:] @ up < np.sqrt(0.5)
    driven = mj_model.actuator_trnid[:, 0]
    # Controls of position servos are target angles.
    off = data.ctrl - data.qpos[mj_model.jnt_qposadr[driven]]
    sag = {
        mj_model.joint(joint).name: float(of_joint)
        for joint, of_joint in zip(driven, off, strict=True)
    }
    drift = float(np.hypot(*(data.qpos[first : first + 2] - start[:2])))
    return Standing(round(float(min(data.time, seconds)), 2), sag, drift)
