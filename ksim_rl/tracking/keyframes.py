"""Turns keyframes of a two-legged robot into a motion: feet stand without slip, and the balance is kept.

The centre of mass moves as a pendulum of variable height over the zero-moment point that the feet allow (Kajita et al.,
"Biped walking pattern generation by using preview control of zero-moment point", 2003; here the whole plan is known, so
that one linear system gives the motion of the centre). The part that the pendulum leaves out, limbs that swing, is
measured by inverse dynamics and put into the plan, until the robot's own zero-moment point is where it should be.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from ksim_rl.checked import Checked, Positive
from ksim_rl.clips.inverse_kinematics import ComGoal, InverseKinematics, PoseGoal
from ksim_rl.tracking.dynamics import GRAVITY, Demand, demand

Array = np.ndarray
Keys = Sequence[tuple[float, float]]
"""(s, value) pairs in the order of time; before the first and after the last key the value stays."""


@dataclass(frozen=True, kw_only=True)
class FootMove(Checked):
    """A foot that leaves the ground at `begin_s` and stands at the place `to` from `end_s` on.

    Attributes:
        foot: 0 or 1, the place among `Figure.feet`.
        to: x, y (m) and heading (rad) of the middle of the sole.
        up: height of that place above the ground, m, such as the top of a box.
        lift, forward, pitch: added on the way: m up, m along the foot's heading, rad by which the toes point
            down; keys at seconds since `begin_s`, zero at both ends.
    """

    foot: int
    begin_s: float
    end_s: float
    to: tuple[float, float, float]
    up: float = 0.0
    lift: Keys = ()
    forward: Keys = ()
    pitch: Keys = ()


@dataclass(frozen=True, kw_only=True)
class Figure:
    """The parts of a robot that keyframes move.

    Attributes:
        feet: sites at the middles of the soles, x forward, z up.
        root, torso: bodies that are kept at their height, and upright.
        sole_z: where a sole's site is while the foot stands, m.
        posture_weights: cost of straying from the posture by joint, rad^-1; others cost `loose`.
    """

    feet: tuple[str, str]
    root: str
    torso: str
    sole_z: float = 0.0
    posture_weights: Mapping[str, float] = field(default_factory=dict)
    loose: float = 0.01


@dataclass(frozen=True, kw_only=True)
class Choreography(Checked):
    """The motion of a figure: footsteps, heights and joints over time.

    Attributes:
        feet: x, y (m) and heading (rad) of each foot at the start.
        root_height, lean: m, and rad by which the torso leans forward.
        joints: offsets of joints from the default pose, rad.
    """

    duration_s: Positive
    feet: tuple[tuple[float, float, float], tuple[float, float, float]]
    moves: Sequence[FootMove] = ()
    root_height: Keys
    lean: Keys = ((0.0, 0.0),)
    joints: Mapping[str, Keys] = field(default_factory=dict)


def eased(keys: Keys, time_F: Float[Array, " F"]) -> Float[Array, " F"]:
    """Return values between keys by the polynomial of fifth degree that rests at each key."""
    key_s, values = (np.array(column, float) for column in zip(*keys, strict=True))
    # A single key holds its value at all times.
    if len(keys) == 1:
        return np.full_like(time_F, values[0])
    # Index of the key before each frame, within the first and the last interval.
    index_F = np.searchsorted(key_s, time_F, side="right") - 1
    index_F = np.clip(index_F, 0, len(keys) - 2)
    since_F = time_F - key_s[index_F]
    share_F = np.clip(since_F / np.diff(key_s)[index_F], 0.0, 1.0)
    # 10 s^3 - 15 s^4 + 6 s^5: velocity and acceleration are zero at both ends.
    smooth_F = share_F**3 * (10.0 - 15.0 * share_F + 6.0 * share_F**2)
    return values[index_F] + smooth_F * np.diff(values)[index_F]


def smoothed(value_FN: Float[Array, "F N"], frames: float) -> Float[Array, "F N"]:
    """Return the columns blurred by a bell of so many frames (its standard deviation), ends held."""
    # Beyond four standard deviations the bell adds nothing.
    reach = int(np.ceil(4.0 * frames))
    bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) / frames) ** 2)
    # The ends are repeated, so that a rest at the ends stays a rest.
    padded = np.pad(value_FN, ((reach, reach), (0, 0)), mode="edge")
    columns = [np.convolve(column, bell / bell.sum(), mode="valid") for column in padded.T]
    return np.stack(columns, axis=-1)


def foot_paths(
    plan: Choreography, time_F: Float[Array, " F"]
) -> tuple[Float[Array, "F N 5"], Bool[Array, "F N"]]:
    """Return x, y, height, heading and pitch of both feet, m and rad, and when they stand.

    Heights are of soles above the ground: a foot that stands on a box is as high as the box.
    """
    # Last dim: x, y, height, heading, pitch.
    paths_FN5 = np.zeros((len(time_F), 2, 5))
    planted_FN = np.ones((len(time_F), 2), bool)
    for foot in (0, 1):
        # Standing at the start until the first move.
        paths_FN5[:, foot, [0, 1, 3]] = plan.feet[foot]
        # In the order of time, as each move starts where the one before has ended.
        moves = [move for move in plan.moves if move.foot == foot]
        for move in sorted(moves, key=lambda move: move.begin_s):
            from_4 = paths_FN5[-1, foot, :4]
            x, y, heading = move.to
            for column, start, end in zip(range(4), from_4, (x, y, move.up, heading), strict=True):
                # Before the move the path so far; after it `eased` holds the place.
                paths_FN5[:, foot, column] = np.where(
                    time_F < move.begin_s,
                    paths_FN5[:, foot, column],
                    eased(((move.begin_s, start), (move.end_s, end)), time_F),
                )
            up_F, ahead_F, pitch_F = (
                _on_the_way(keys, move, time_F) for keys in (move.lift, move.forward, move.pitch)
            )
            # Forward is along the heading of each frame, which may turn on the way.
            heading_F = paths_FN5[:, foot, 3]
            paths_FN5[:, foot, 0] += ahead_F * np.cos(heading_F)
            paths_FN5[:, foot, 1] += ahead_F * np.sin(heading_F)
            paths_FN5[:, foot, 2] += up_F
            paths_FN5[:, foot, 4] += pitch_F
            # Both edges count as standing: the foot is at rest there.
            planted_FN[:, foot] &= (time_F <= move.begin_s) | (time_F >= move.end_s)
    return paths_FN5, planted_FN


def _on_the_way(keys: Keys, move: FootMove, time_F: Array) -> Array:
    inner = [(move.begin_s + second, value) for second, value in keys]
    # Zero at both ends, whatever the keys between are.
    return eased([(move.begin_s, 0.0), *inner, (move.end_s, 0.0)], time_F)


def zmp_plan(
    paths_FN5: Float[Array, "F N 5"], planted_FN: Bool[Array, "F N"], *, shift_frames: int
) -> Float[Array, "F 2"]:
    """Return where the ground's pressure should have its centre: on the foot that stands alone, else between them.

    It rests midway between the feet, and moves in `shift_frames` before a foot leaves the ground and after one comes
    down; it moves all the while that both feet stand, if that is shorter than both.
    """
    alone_F = planted_FN.sum(1) == 1
    middle_F2 = paths_FN5[:, :, :2].mean(1)
    # The standing foot; where both stand, this is not used.
    first_F2 = paths_FN5[:, 0, :2]
    second_F2 = paths_FN5[:, 1, :2]
    on_foot_F2 = np.where(planted_FN[:, :1], first_F2, second_F2)
    keys: list[tuple[int, Array]] = [(0, middle_F2[0])]
    # Changes between standing on one foot and on two; motions begin and end on two.
    edges = np.flatnonzero(np.diff(alone_F.astype(int)))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        both = begin - keys[-1][0]
        # With time enough the pressure rests in the middle, else it moves from foot to foot.
        if both > 2 * shift_frames:
            if keys[-1][0]:
                keys.append((keys[-1][0] + shift_frames, middle_F2[begin]))
            keys.append((begin - shift_frames, middle_F2[begin]))
        # From lift-off to landing the pressure stays on the standing foot.
        keys += [(begin, on_foot_F2[begin + 1]), (end + 1, on_foot_F2[end])]
    if len(keys) > 1:
        rests_at = min(keys[-1][0] + shift_frames, len(alone_F) - 1)
        keys.append((rests_at, middle_F2[-1]))
    frames, places = zip(*keys, strict=True)
    every_F = np.arange(len(alone_F))
    columns = [np.interp(every_F, frames, column) for column in np.array(places).T]
    return np.stack(columns, axis=-1)


def pendulum(
    zmp_F2: Float[Array, "F 2"], height_F: Float[Array, " F"], fps: float
) -> Float[Array, "F 2"]:
    """Return the centre of mass that moves as a pendulum over a zero-moment point; it rests at both ends.

    It solves x - z x'' / (g + z'') = p with x'' as the second difference of x.
    """
    # Acceleration of the height adds to gravity, m/s^2.
    lift_F = np.gradient(np.gradient(height_F, 1.0 / fps), 1.0 / fps)
    # z / g in units of frames^2, as x'' is a second difference of frames.
    ratio_F = height_F / (GRAVITY + lift_F) * fps**2
    # No acceleration at the ends: the first and last row become x = p.
    ratio_F[[0, -1]] = 0.0
    count = len(ratio_F)
    # Tridiagonal; a dense solve is quick enough for some hundred frames.
    diagonal_FF = np.diag(1.0 + 2.0 * ratio_F)
    below_FF = np.diag(ratio_F[1:], -1)
    above_FF = np.diag(ratio_F[:-1], 1)
    system_FF = diagonal_FF - below_FF - above_FF
    assert system_FF.shape == (count, count)
    return np.linalg.solve(system_FF, zmp_F2)


def perform(
    mj_model: mujoco.MjModel,
    figure: Figure,
    plan: Choreography,
    *,
    fps: float = 50.0,
    rounds: int = 4,
    shift_s: float = 0.5,
) -> tuple[Float[Array, "F L"], Demand, Bool[Array, "F N"]]:
    """Return the qpos of each frame, its demand, and the feet that stand; balance is improved `rounds` times.

    The robot is alone in its model, and the model's first keyframe is the pose that it returns to.
    """
    # Both ends included.
    time_F = np.arange(round(plan.duration_s * fps) + 1) / fps
    paths_FN5, planted_FN = foot_paths(plan, time_F)
    # Steps of the plan are blurred, as a jump of pressure asks for endless acceleration.
    planned_F2 = zmp_plan(paths_FN5, planted_FN, shift_frames=round(shift_s * fps))
    zmp_F2 = smoothed(planned_F2, 1.5)
    posture_FL, weight_M = _posture(mj_model, figure, plan, time_F)
    root_F = eased(plan.root_height, time_F)
    lean_F = eased(plan.lean, time_F)
    # Between the headings of the feet, and blurred: the trunk does not turn with each step.
    middle_F1 = paths_FN5[:, :, 3].mean(1, keepdims=True)
    heading_F = smoothed(middle_F1, 0.1 * fps)[:, 0]
    solver = InverseKinematics(mj_model)
    # The height of what is stood on, without jumps.
    level_FN = paths_FN5[:, :, 2]
    standing_F = np.where(planted_FN, level_FN, 0.0).sum(1) / np.maximum(planted_FN.sum(1), 1)
    level_F = smoothed(standing_F[:, None], 0.1 * fps)[:, 0]
    # A first guess of the centre of mass: somewhat below the root. It is replaced by the true one.
    height_F = root_F - 0.09 - level_F
    aim_F2 = zmp_F2.copy()
    qpos_FL = posture_FL
    asked = None
    # The pendulum has no arms and legs: their swing shifts the zero-moment point, and the aim corrects it.
    for _ in range(rounds + 1):
        com_F2 = pendulum(aim_F2, height_F, fps)
        qpos_FL = _solved(
            solver, figure, paths_FN5, com_F2, root_F, lean_F, heading_F, posture_FL, weight_M
        )
        asked = demand(
            mj_model,
            qpos_FL,
            fps,
            feet=figure.feet,
            planted_FN=planted_FN,
            level_FN=level_FN,
        )
        height_F = asked.com_F3[:, 2] - level_F
        # Move the aim against the error, blurred as frames next to each other disagree.
        aim_F2 = aim_F2 + smoothed(zmp_F2 - asked.zmp_F2, 1.0)
    assert asked is not None
    return qpos_FL, asked, planted_FN


def _posture(
    mj_model: mujoco.MjModel, figure: Figure, plan: Choreography, time_F: Array
) -> tuple[Array, Array]:
    """Return the pose that is kept where nothing else is asked for, by frame, and the cost of straying from it."""
    posture_FL = np.tile(mj_model.key_qpos[0], (len(time_F), 1))
    weight_M = np.full(mj_model.nv, figure.loose)
    # The root is placed by the goals alone.
    weight_M[:6] = 0.0
    for joint, weight in figure.posture_weights.items():
        dof = mj_model.joint(joint).dofadr[0]
        weight_M[dof] = weight
    # Offsets of the joints that the plan names, from the default pose.
    for joint, keys in plan.joints.items():
        place = mj_model.joint(joint).qposadr[0]
        posture_FL[:, place] += eased(keys, time_F)
    return posture_FL, weight_M


def _solved(
    solver: InverseKinematics,
    figure: Figure,
    paths_FN5: Array,
    com_F2: Array,
    root_F: Array,
    lean_F: Array,
    heading_F: Array,
    posture_FL: Array,
    weight_M: Array,
) -> Array:
    # Each frame is searched for from the one before, so that the motion stays continuous.
    qpos_L = posture_FL[0].copy()
    found = []
    for frame, posture_L in enumerate(posture_FL):
        goals: list[PoseGoal | ComGoal] = [ComGoal(pos_N=com_F2[frame])]
        for foot, (x, y, z, heading, pitch) in zip(figure.feet, paths_FN5[frame], strict=True):
            place_3 = np.array((x, y, z + figure.sole_z))
            # Feet weigh most: a sole that slides or tilts cannot be balanced away.
            goals.append(
                PoseGoal(name=foot, pos_3=place_3, quat_4=turned(heading, pitch), weight=3.0)
            )
        height_3 = np.array((0.0, 0.0, root_F[frame]))
        level = turned(heading_F[frame], 0.0)
        goals += [
            # Only the height of the root counts; x and y follow from the balance.
            PoseGoal(
                name=figure.root,
                pos_3=height_3,
                quat_4=level,
                weight=(0.0, 0.0, 1.0),
                turn_weight=0.1,
            ),
            PoseGoal(
                name=figure.torso,
                pos_3=height_3,
                quat_4=turned(heading_F[frame], lean_F[frame]),
                weight=0.0,
                # A place for the torso is not asked for, only its orientation.
                turn_weight=0.3,
            ),
        ]
        qpos_L = solver.solve(goals, start_L=qpos_L, posture_L=posture_L, posture_weight_M=weight_M)
        found.append(qpos_L)
    return np.array(found)


def turned(heading: float, pitch: float) -> Float[Array, " 4"]:
    """Return the orientation that is pitched about y, then turned about z, rad, as (w, x, y, z)."""
    half_heading = heading / 2
    half_pitch = pitch / 2
    heading_4 = np.array((np.cos(half_heading), 0.0, 0.0, np.sin(half_heading)))
    pitch_4 = np.array((np.cos(half_pitch), 0.0, np.sin(half_pitch), 0.0))
    both_4 = np.empty(4)
    mujoco.mju_mulQuat(both_4, heading_4, pitch_4)
    return both_4
