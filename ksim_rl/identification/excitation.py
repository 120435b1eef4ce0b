"""Proposes commands that make the joints of a held robot show their numbers.

Each joint gets a sum of sines of its own, slow ones with large and fast ones with small amplitudes: friction and
damping show in slow and quick motion, inertia in fast. All are scaled down until the robot, as its files have it, stays
within a share of its limits and touches nothing of itself. Efforts and velocities, which few sines excite as positions
do, have sines of their own, so that the effects of the kinds of command can be separated.
"""

import copy
from collections.abc import Collection

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.identification.held_robot import DrivenJoint, HeldRobot
from ksim_rl.identification.simulation import Candidate, Simulation, Targets, efforts
from ksim_rl.scene.state.joint_control import TargetKind

Array = np.ndarray
SECONDS = 60.0
RATE = 500.0
LOWEST_HZ = 0.1
HIGHEST_HZ = 8.0
NUM_SINES = 24
FADE_S = 1.0
POSITION_SLOPE = 0.7
"""Amplitudes of positions fall with this power of the frequency, others with `OTHER_SLOPE`."""
OTHER_SLOPE = 0.3
REACH = 0.45
"""Share of the way from the middle of the motion to the nearer limit."""
UNLIMITED_REACH = 0.5
"""rad or m, of a joint without limits."""
SPEED = 3.0
"""Largest commanded velocity, rad/s or m/s."""
EFFORT = 0.2
"""Largest commanded effort, of the limit."""
UNLIMITED_EFFORT = 2.0
"""Largest commanded effort of a joint without a limit, N m or N."""
MOST_EFFORT = 0.6
"""Share of the limit that all commands together may ask for."""
MARGIN = 0.05
"""Share of the range that stays free at both ends."""
SHRINK = 0.85
SHRINK_OF_LIMB = 0.95
MOST_SHRINKS = 24
NUM_POSES = 100
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
SEEN_HZ = 50.0
"""How often self contacts are looked for."""


def propose(
    robot: HeldRobot, kinds: Collection[TargetKind], *, seconds: float = SECONDS, seed: int = 0
) -> Targets:
    """Return commands of these kinds at `RATE`, for a robot whose base is held.

    A ValueError names a joint that cannot be moved without reaching a limit.
    """
    time_T = np.arange(int(round(seconds * RATE))) / RATE
    rng = np.random.default_rng(seed)
    # Poses first, so that they are the same with all kinds of commands.
    middle_N, reach_N = _places(robot, rng)
    num = len(robot.joints)
    shapes = {}
    for kind in sorted(kinds):
        slope = POSITION_SLOPE if kind == "pos" else OTHER_SLOPE
        shapes[kind] = _sines(rng, time_T, num, slope)
    limit_N = np.array([joint.effort_limit for joint in robot.joints])
    effort_N = np.where(np.isinf(limit_N), UNLIMITED_EFFORT, EFFORT * limit_N)
    sizes = {"pos": reach_N, "vel": np.full(num, SPEED), "effort": effort_N}
    scale_N = np.ones(num)
    why = ""
    for _ in range(MOST_SHRINKS):
        by_kind: dict[TargetKind, Array] = {}
        for kind, shape_TN in shapes.items():
            by_kind[kind] = shape_TN * sizes[kind] * scale_N
        if "pos" in by_kind:
            by_kind["pos"] = np.clip(by_kind["pos"] + middle_N, *_free_ranges(robot))
        targets = Targets(time_T=time_T, by_kind=by_kind)
        pos_TN = _simulated(robot, targets, middle_N)
        too_much, why = _too_much(robot, targets, pos_TN)
        if not too_much:
            return targets
        scale_N[sorted(too_much)] *= SHRINK
        # Joints are moved by the rest of their limb, too.
        limbs = {robot.joints[place].limb for place in too_much}
        scale_N[[joint.limb in limbs for joint in robot.joints]] *= SHRINK_OF_LIMB
        # Weight pulls servos off their targets: these move the other way, as far as that is inside of the range.
        low_N, high_N = _free_ranges(robot)
        sags = (pos_TN.min(axis=0) < low_N) | (pos_TN.max(axis=0) > high_N)
        middle_N = np.where(sags, middle_N + 0.5 * (low_N + high_N) - pos_TN.mean(axis=0), middle_N)
    raise ValueError(f"{robot.name}: even small motions reach a limit: {why}")


def _sines(rng: np.random.Generator, time_T: Array, num: int, slope: float) -> Float[Array, "T N"]:
    """Return sums of sines with random phases, one for each joint, which reach 1 and begin and end with 0."""
    usual_hz_W = np.geomspace(LOWEST_HZ, HIGHEST_HZ, NUM_SINES)
    columns = []
    for _ in range(num):
        # Other frequencies for each joint, so that no two move together.
        hz_W = usual_hz_W * np.exp(rng.uniform(-0.05, 0.05, NUM_SINES))
        phase_W = rng.uniform(0.0, 2.0 * np.pi, NUM_SINES)
        waves_TW = np.sin(2.0 * np.pi * hz_W * time_T[:, None] + phase_W)
        sum_T = waves_TW @ hz_W**-slope
        columns.append(sum_T / np.abs(sum_T).max())
    to_end_T = np.minimum(time_T, time_T[-1] - time_T)
    faded_T = np.clip(to_end_T / FADE_S, 0.0, 1.0)
    return np.stack(columns, axis=1) * (faded_T**2 * (3.0 - 2.0 * faded_T))[:, None]


def _places(
    robot: HeldRobot, rng: np.random.Generator
) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Return about which position each joint moves and how far it may, between the default pose and mid-range.

    It is the nearest to the default pose of a few in which the robot's parts meet least.
    """
    away = rng.uniform(-0.5, 0.5, (NUM_POSES, len(robot.joints)))
    fewest = NUM_POSES + 1
    middle_N = reach_N = np.zeros(len(robot.joints))
    for share in SHARES:
        places = [_place(joint, share) for joint in robot.joints]
        own_N, own_reach_N = np.array(places).T
        touching = _touching(robot, own_N + away * own_reach_N)
        meetings = sum(bool(pairs) for pairs in touching)
        if meetings < fewest:
            fewest = meetings
            middle_N = own_N
            reach_N = own_reach_N
    return middle_N, reach_N


def _place(joint: DrivenJoint, share: float) -> tuple[float, float]:
    """Return the middle and the reach of a joint's motion, a share of the way from its default to mid-range."""
    low, high = joint.range
    if np.isinf(high - low):
        return joint.rest, UNLIMITED_REACH
    third = (high - low) / 3.0
    near = min(max(joint.rest, low + third), high - third)
    middle = (1.0 - share) * near + share * 0.5 * (low + high)
    return middle, REACH * min(middle - low, high - middle)


def _free_ranges(robot: HeldRobot) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """Return the ends of the joints' ranges less the margin; infinite without limits."""
    low_N, high_N = np.array([joint.range for joint in robot.joints]).T
    has_limits = np.isfinite(high_N - low_N)
    margin_N = np.zeros(len(robot.joints))
    margin_N[has_limits] = MARGIN * (high_N - low_N)[has_limits]
    return low_N + margin_N, high_N - margin_N


def _simulated(
    robot: HeldRobot, targets: Targets, start_N: Float[Array, " N"]
) -> Float[Array, "T N"]:
    """Return the joints' positions under targets, of the robot as its files have it."""
    simulation = Simulation(robot, targets, num_candidates=1)
    as_filed = Candidate(numbers_NP=robot.nominal_NP(), delay_s=0.0)
    return simulation.positions([as_filed], targets.time_T, start_N)[0]


def _too_much(
    robot: HeldRobot, targets: Targets, pos_TN: Float[Array, "T N"]
) -> tuple[set[int], str]:
    """Return the places of joints that move or push too much, and a line about the first."""
    vel_TN = np.gradient(pos_TN, targets.time_T, axis=0)
    effort_TN = efforts(robot.nominal_NP(), targets.by_kind, pos_TN, vel_TN)
    low_N, high_N = _free_ranges(robot)
    found: dict[int, str] = {}
    for place, joint in enumerate(robot.joints):
        if pos_TN[:, place].min() < low_N[place] or pos_TN[:, place].max() > high_N[place]:
            found[place] = f"joint {joint.name!r} comes near the end of its range"
        elif np.abs(effort_TN[:, place]).max() > MOST_EFFORT * joint.effort_limit:
            found[place] = (
                f"joint {joint.name!r} needs more than {MOST_EFFORT:.0%} of its effort limit"
            )
    seen = _touching(robot, pos_TN[:: int(RATE / SEEN_HZ)])
    # What touches at the start is meant to, as a foot that hangs in a frame.
    met = set().union(*seen[1:]) - seen[0]
    for place in _joints_of(robot, met):
        found.setdefault(
            place, f"joint {robot.joint_names[place]!r} brings parts of the robot together"
        )
    return set(found), next(iter(found.values()), "")


def _joints_of(robot: HeldRobot, pairs: Collection[tuple[int, int]]) -> set[int]:
    """Return the places of the joints that move some body of these pairs."""
    mj_model = robot.mj_model
    moved = set()
    for place, name in enumerate(robot.joint_names):
        body = int(mj_model.joint(name).bodyid[0])
        for first, second in pairs:
            # A joint that carries both moves neither against the other.
            if _hangs_on(mj_model, first, body) != _hangs_on(mj_model, second, body):
                moved.add(place)
    return moved


def _touching(robot: HeldRobot, pos_KN: Float[Array, "K N"]) -> list[set[tuple[int, int]]]:
    """Return the pairs of bodies that touch in each of some poses."""
    mj_model = copy.copy(robot.mj_model)
    mj_model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(mj_model)
    address_N = [mj_model.joint(name).qposadr[0] for name in robot.joint_names]
    return [_pairs(mj_model, data, address_N, pos_N) for pos_N in pos_KN]


def _pairs(
    mj_model: mujoco.MjModel, data: mujoco.MjData, address_N: list[int], pos_N: Float[Array, " N"]
) -> set[tuple[int, int]]:
    """Return the pairs of bodies that touch in a pose."""
    data.qpos[address_N] = pos_N
    mujoco.mj_kinematics(mj_model, data)
    mujoco.mj_comPos(mj_model, data)
    mujoco.mj_collision(mj_model, data)
    contacts = data.contact
    found = set()
    for geoms, distance in zip(contacts.geom, contacts.dist, strict=True):
        if distance < 0.0:
            first, second = sorted(int(body) for body in mj_model.geom_bodyid[geoms])
            found.add((first, second))
    return found


def _hangs_on(mj_model: mujoco.MjModel, body: int, above: int) -> bool:
    """Whether a body is another one, or hangs on it."""
    while body > above:
        body = int(mj_model.body_parentid[body])
    return body == above
