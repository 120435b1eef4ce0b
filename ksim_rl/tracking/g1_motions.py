"""The motions of Unitree G1 that come with the package, as keyframes: walk, squat, turn, kick."""

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.clips.motion_file import write_motion
from ksim_rl.scene.robots.unitree_g1 import JOINTS, UnitreeG1
from ksim_rl.tracking.keyframes import Choreography, Figure, FootMove, Keys, perform

ROBOT = UnitreeG1()
FPS = 50.0
STAND = 0.76
"""m: the root's height in the default pose."""
FEET_APART = 0.1185
"""m: each foot's distance from the middle."""
MIDDLE = 0.0388
"""m: the middle of the soles is ahead of the root."""
FEET = ((MIDDLE, FEET_APART, 0.0), (MIDDLE, -FEET_APART, 0.0))
NARROW = ((MIDDLE, 0.095, 0.0), (MIDDLE, -0.095, 0.0))
"""Feet near enough to each other to stand on one without leaning far."""
# Arms and waist keep their posture: else the search would balance with them.
_ARMS = {name: 0.5 for name in JOINTS if "shoulder" in name or "elbow" in name or "wrist" in name}
_WAIST = dict.fromkeys(("waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint"), 0.1)
# The feet's sites lie 2 mm below the soles.
FIGURE = Figure(
    feet=UnitreeG1.foot_sites,  # type: ignore[arg-type]
    root=UnitreeG1.root_body,
    torso=UnitreeG1.torso_body,
    sole_z=-0.002,
    posture_weights={**_ARMS, **_WAIST},
)


def model() -> mujoco.MjModel:
    """Return the robot alone."""
    return ROBOT.spec().compile()


def _swing(times: list[float], amplitude: float, *, first: float = 1.0) -> Keys:
    """Return keys that are zero at the first and last time, and `amplitude` with alternating signs between them."""
    # The keys inside swing to one side and the other in turn.
    inner = [
        (time, first * amplitude * (-1.0) ** number) for number, time in enumerate(times[1:-1])
    ]
    return ((times[0], 0.0), *inner, (times[-1], 0.0))


def _arm_swing(
    begin_s: float, step_s: float, count: int, *, shoulder: float, elbow: float
) -> dict[str, Keys]:
    """Return arms that swing in turn with so many steps, rad; a bent elbow follows its shoulder."""
    # Late in each step, so that an arm is furthest out as its foot comes down.
    steps = (begin_s + (number + 0.9) * step_s for number in range(count))
    times = [begin_s - 0.3, *steps, begin_s + count * step_s + 0.6]
    keys: dict[str, Keys] = {}
    # Left and right swing against each other.
    for side, sign in (("left", 1.0), ("right", -1.0)):
        keys[f"{side}_shoulder_pitch_joint"] = _swing(times, shoulder, first=sign)
        keys[f"{side}_elbow_joint"] = _swing(times, elbow, first=-sign)
    return keys


def _arms_out(begin_s: float, end_s: float, by: float) -> dict[str, Keys]:
    """Return arms that are held off the legs, rad."""
    keys: dict[str, Keys] = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        out = sign * by
        keys[f"{side}_shoulder_roll_joint"] = (
            (begin_s, 0.0),
            (begin_s + 0.6, out),
            (end_s - 0.6, out),
            (end_s, 0.0),
        )
    return keys


def walk() -> Choreography:
    """Return twelve steps straight ahead."""
    # Step time, of which both feet stand for a tenth of a second; stride in m.
    begin_s = 0.9
    step_s = 0.54
    both_s = 0.1
    stride = 0.24
    count = 12
    moves = []
    at = [MIDDLE, MIDDLE]
    for number in range(count):
        foot = number % 2
        last = number == count - 1
        # The first step is half as long, and the last one brings the feet together.
        length = 0.5 * stride if number == 0 else stride
        if last:
            length = 0.0
        # From the foot that is ahead, so each step passes the other foot by a stride.
        at[foot] = max(at) + length
        start = begin_s + number * step_s
        swing_s = step_s - both_s
        moves.append(
            FootMove(
                foot=foot,
                begin_s=start,
                end_s=start + swing_s,
                # Foot 0 is the left one, whose side is positive y.
                to=(at[foot], (1 - 2 * foot) * FEET_APART, 0.0),
                lift=((0.5 * swing_s, 0.08),),
                pitch=((0.4 * swing_s, 0.45),),
            )
        )
    end_s = begin_s + count * step_s
    # Knees bend a little for the walk, and stretch again at the end.
    return Choreography(
        duration_s=end_s + 1.2,
        feet=FEET,
        moves=moves,
        root_height=((0.2, STAND), (0.8, 0.72), (end_s, 0.72), (end_s + 0.7, STAND)),
        lean=((0.2, 0.0), (0.9, 0.06), (end_s, 0.06), (end_s + 0.6, 0.0)),
        joints=_arm_swing(begin_s, step_s, count, shoulder=0.45, elbow=0.35),
    )


def squat() -> Choreography:
    """Return four squats with the arms raised ahead at the bottom."""
    begin_s = 0.6
    # One squat, s: down, a short rest and up.
    cycle_s = 1.85
    count = 4
    height = [(begin_s, STAND)]
    lean = [(begin_s, 0.0)]
    arms = [(begin_s, 0.0)]
    elbows = [(begin_s, 0.0)]
    for number in range(count):
        down = begin_s + (number + 0.45) * cycle_s
        up = begin_s + (number + 1) * cycle_s
        # Root height (m), and lean, arms and elbows (rad) at the bottom.
        for keys, low in ((height, 0.47), (lean, 0.35), (arms, -1.4), (elbows, 0.5)):
            rest = STAND if keys is height else 0.0
            keys += [(down, low), (down + 0.1 * cycle_s, low), (up, rest)]
    return Choreography(
        duration_s=begin_s + count * cycle_s + 0.6,
        feet=FEET,
        root_height=height,
        lean=lean,
        joints={
            **{f"{side}_shoulder_pitch_joint": arms for side in ("left", "right")},
            **{f"{side}_elbow_joint": elbows for side in ("left", "right")},
        },
    )


def turn() -> Choreography:
    """Return a full turn to the left on the spot, in steps."""
    begin_s = 0.9
    step_s = 0.5
    both_s = 0.12
    count = 14
    moves = []
    # Two steps for each seventh of the turn: the left foot turns first, the right one follows.
    turn_by = 2.0 * math.pi / (count // 2)
    headings = [0.0, 0.0]
    for number in range(count):
        foot = number % 2
        other = headings[1 - foot]
        # The left foot leads; the right foot comes to its heading.
        headings[foot] = other + turn_by if foot == 0 else other
        heading = headings[foot]
        side = (1 - 2 * foot) * FEET_APART
        # The feet move on circles about the root.
        x = MIDDLE * math.cos(heading) - side * math.sin(heading)
        y = MIDDLE * math.sin(heading) + side * math.cos(heading)
        start = begin_s + number * step_s
        swing_s = step_s - both_s
        moves.append(
            FootMove(
                foot=foot,
                begin_s=start,
                end_s=start + swing_s,
                to=(x, y, heading),
                lift=((0.5 * swing_s, 0.08),),
            )
        )
    end_s = begin_s + count * step_s
    return Choreography(
        duration_s=end_s + 1.2,
        feet=FEET,
        moves=moves,
        root_height=((0.2, STAND), (0.8, 0.7), (end_s, 0.7), (end_s + 0.7, STAND)),
        joints={
            **_arm_swing(begin_s, step_s, count, shoulder=0.45, elbow=0.4),
            # Arms are held off the legs, which turn below them.
            **_arms_out(0.2, end_s + 0.8, 0.15),
        },
    )


def kick() -> Choreography:
    """Return two kicks with the right leg, then two with the left, each pair on the other leg alone."""
    raise_s = 0.45
    kick_s = 0.42
    rest_s = 0.35
    # Seconds on one leg: raise the foot, two kicks of out and back, then rest.
    alone_s = raise_s + 4 * kick_s + rest_s
    moves = []
    begin_s = 1.2
    arms: dict[str, list[tuple[float, float]]] = {name: [(0.6, 0.0)] for name in ("left", "right")}
    # Right leg first, while the left one stands.
    for foot in (1, 0):
        # The foot is behind the hip at first, and is so again after each of two kicks.
        lift = [(raise_s, 0.22)]
        forward = [(raise_s, -0.12)]
        pitch = [(raise_s, 0.5)]
        swing = [(raise_s, 0.7)]
        for number in range(2):
            # Out and back: two beats of `kick_s` for each kick.
            out_s = raise_s + (number + 0.5) * 2 * kick_s
            back_s = raise_s + (number + 1) * 2 * kick_s
            lift += [(out_s, 0.30), (back_s, 0.22)]
            forward += [(out_s, 0.38), (back_s, -0.12)]
            pitch += [(out_s, -0.5), (back_s, 0.5)]
            swing += [(out_s, -0.7), (back_s, 0.7)]
        moves.append(
            FootMove(
                foot=foot,
                begin_s=begin_s,
                end_s=begin_s + alone_s,
                to=NARROW[foot],
                lift=lift,
                forward=forward,
                pitch=pitch,
            )
        )
        # Arms swing against the leg that kicks.
        for side, sign in (("left", 1.0), ("right", -1.0)):
            toward = sign if foot == 1 else -sign
            arms[side] += [(begin_s + time, angle * toward) for time, angle in swing]
            arms[side].append((begin_s + alone_s, 0.0))
        # A second on both feet between the two legs.
        begin_s += alone_s + 1.0
    joints = _arms_out(0.2, begin_s, 0.3)
    for side in arms:
        joints[f"{side}_shoulder_pitch_joint"] = arms[side]
        joints[f"{side}_elbow_joint"] = [(time, -0.6 * value) for time, value in arms[side]]
    return Choreography(
        duration_s=begin_s + 0.2,
        feet=NARROW,
        moves=moves,
        root_height=((0.3, STAND), (1.0, 0.73), (begin_s - 1.0, 0.73), (begin_s - 0.3, STAND)),
        joints=joints,
    )


@dataclass(frozen=True, kw_only=True)
class Clip:
    """A motion that comes with the package, `description` one line, and the time in which weight moves between feet."""

    description: str
    plan: Callable[[], Choreography]
    shift_s: float = 0.5


CLIPS: Mapping[str, Clip] = {
    "g1_walk": Clip(description="twelve steps straight ahead", plan=walk),
    "g1_squat": Clip(description="four squats", plan=squat),
    "g1_turn": Clip(description="a full turn on the spot", plan=turn),
    "g1_kick": Clip(description="two kicks with each leg", plan=kick, shift_s=0.6),
}
"""The motions by the name of their file."""


def made(name: str) -> Float[np.ndarray, "F L"]:
    """Return the qpos of a motion of `CLIPS`, 50 frames per second, made from its keyframes; it takes some seconds."""
    clip = CLIPS[name]
    qpos_FL, _, _ = perform(model(), FIGURE, clip.plan(), fps=FPS, shift_s=clip.shift_s)
    return qpos_FL


if __name__ == "__main__":
    # The files of the package are made by this, not by hand.
    # Writes the files again: python -m ksim_rl.tracking.g1_motions FOLDER
    for name in CLIPS:
        write_motion(Path(sys.argv[1]) / f"{name}.npz", model(), made(name), FPS)
