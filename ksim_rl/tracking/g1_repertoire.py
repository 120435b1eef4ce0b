"""The clips of Unitree G1 from which one policy learns many motions: thirteen kinds, each with several ways to do it.

A clip is named `<kind>_<variant>`, and its mirror image `<kind>_<variant>_mirrored`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from ksim_rl.tracking.g1_gestures import gesture
from ksim_rl.tracking.g1_motions import FEET, FEET_APART, MIDDLE, NARROW, STAND, Clip
from ksim_rl.tracking.keyframes import Choreography, FootMove, Keys

WALKING = 0.72
"""m: the root's height while feet are lifted, so that the knees have room."""
BEGIN_S = 0.9
"""s: until then weight moves onto the first standing foot."""
GESTURES = 16
"""Random gestures: the seeds below it."""
Step = tuple[float, float, float]
"""m ahead, m to the left, and rad to the left by which the place of the feet moves with a step."""


def there_and_back(begin_s: float, end_s: float, by: float, *, ease_s: float = 0.7) -> Keys:
    """Return keys that go to an offset, hold it, and come back, within a time."""
    return ((begin_s, 0.0), (begin_s + ease_s, by), (end_s - ease_s, by), (end_s, 0.0))


def beats(begin_s: float, beat_s: float, count: int, by: float) -> Keys:
    """Return keys that go to an offset and back once in each beat."""
    keys = [(begin_s, 0.0)]
    for number in range(count):
        start = begin_s + number * beat_s
        keys += [(start + 0.5 * beat_s, by), (start + beat_s, 0.0)]
    return keys


def both_arms(joint: str, keys: Keys, *, mirrored: bool = False) -> dict[str, Keys]:
    """Return the keys of a joint of both arms; the right one's are negated for rolls and yaws (`mirrored`)."""
    sign = -1.0 if mirrored else 1.0
    right = [(time, sign * value) for time, value in keys]
    return {f"left_{joint}_joint": keys, f"right_{joint}_joint": right}


def stepping(
    steps: Sequence[Step],
    *,
    step_s: float = 0.54,
    both_s: float = 0.12,
    lift: float = 0.08,
    lean: float = 0.0,
    first: int = 0,
    joints: Mapping[str, Keys] | None = None,
) -> Choreography:
    """Return steps of the feet in turn, the left one first; the last two bring the feet together."""
    x = MIDDLE
    y = heading = 0.0
    moves = []
    for number, (ahead, left, turn) in enumerate(steps):
        foot = (first + number) % 2
        heading += turn
        x += ahead * math.cos(heading) - left * math.sin(heading)
        y += ahead * math.sin(heading) + left * math.cos(heading)
        # The feet stand to both sides of the place, whose middle is ahead of the root.
        side = (1 - 2 * foot) * FEET_APART
        begin_s = BEGIN_S + number * step_s
        swing_s = step_s - both_s
        to = (x - side * math.sin(heading), y + side * math.cos(heading), heading)
        moves.append(
            FootMove(
                foot=foot,
                begin_s=begin_s,
                end_s=begin_s + swing_s,
                to=to,
                lift=((0.5 * swing_s, lift),),
            )
        )
    end_s = BEGIN_S + len(steps) * step_s
    return Choreography(
        duration_s=end_s + 1.2,
        feet=FEET,
        moves=moves,
        root_height=((0.2, STAND), (0.8, WALKING), (end_s, WALKING), (end_s + 0.7, STAND)),
        lean=((0.2, 0.0), (0.9, lean), (end_s, lean), (end_s + 0.6, 0.0)),
        joints={
            # Arms are held off the legs.
            **both_arms(
                "shoulder_roll", there_and_back(0.2, end_s + 0.6, 0.15, ease_s=0.6), mirrored=True
            ),
            **(joints or {}),
        },
    )


def walk(
    stride: float, *, turn: float = 0.0, count: int = 10, step_s: float = 0.54
) -> Choreography:
    """Return a walk with steps of `stride` m, backwards if negative, that turns by `turn` rad in each."""
    # Half a step to begin with, and one that brings the feet together.
    steps = [(0.5 * stride, 0.0, turn), *[(stride, 0.0, turn)] * (count - 2), (0.0, 0.0, 0.0)]
    end_s = BEGIN_S + count * step_s
    swing = min(0.45, 2.0 * abs(stride))
    arms: dict[str, Keys] = {}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        inner = [
            (BEGIN_S + (number + 0.9) * step_s, sign * swing * (-1.0) ** number)
            for number in range(count)
        ]
        arms[f"{side}_shoulder_pitch_joint"] = [(0.6, 0.0), *inner, (end_s + 0.6, 0.0)]
    return stepping(
        steps, step_s=step_s, both_s=0.1, lean=0.05 if stride > 0.0 else 0.0, joints=arms
    )


def turn(by: float, *, count: int = 8, step_s: float = 0.5) -> Choreography:
    """Return a turn on the spot by `by` rad with each pair of steps."""
    return stepping([(0.0, 0.0, by), (0.0, 0.0, 0.0)] * (count // 2), step_s=step_s)


def side_step(by: float, *, count: int = 8, step_s: float = 0.54) -> Choreography:
    """Return steps to the left, `by` m with each pair."""
    return stepping([(0.0, by, 0.0), (0.0, 0.0, 0.0)] * (count // 2), step_s=step_s)


def march(lift: float, *, count: int = 8, step_s: float = 0.54, arms: float = 0.0) -> Choreography:
    """Return steps on the spot that lift the feet by `lift` m, with arms that swing by `arms` rad."""
    swings = beats(BEGIN_S, 2.0 * step_s, count // 2, arms)
    joints = {"left_shoulder_pitch_joint": swings}
    joints["right_shoulder_pitch_joint"] = [(time + step_s, value) for time, value in swings]
    return stepping([(0.0, 0.0, 0.0)] * count, step_s=step_s, lift=lift, joints=joints)


def standing(
    duration_s: float,
    *,
    height: Keys = ((0.0, STAND),),
    lean: Keys = ((0.0, 0.0),),
    joints: Mapping[str, Keys],
) -> Choreography:
    """Return a motion in which both feet stay where they are."""
    return Choreography(
        duration_s=duration_s, feet=FEET, root_height=height, lean=lean, joints=joints
    )


def squat(low: float, *, cycle_s: float = 1.85, arms: float = -1.4, count: int = 3) -> Choreography:
    """Return squats down to a root at `low` m, with arms that are raised by `arms` rad."""
    begin_s = 0.6
    # The deeper, the further the trunk leans ahead.
    lean = 1.2 * (STAND - low)
    height = [(time, STAND + value) for time, value in beats(begin_s, cycle_s, count, low - STAND)]
    raised = beats(begin_s, cycle_s, count, arms)
    return standing(
        begin_s + count * cycle_s + 0.6,
        height=height,
        lean=beats(begin_s, cycle_s, count, lean),
        joints=both_arms("shoulder_pitch", raised),
    )


def sit(low: float, *, rest_s: float, lean: float, down_s: float = 1.4) -> Choreography:
    """Return sitting down to a root at `low` m without a chair, a rest there, and rising."""
    end_s = 0.5 + 2.0 * down_s + rest_s
    way = there_and_back(0.5, end_s, low - STAND, ease_s=down_s)
    return standing(
        end_s + 0.7,
        height=[(time, STAND + value) for time, value in way],
        lean=there_and_back(0.5, end_s, lean, ease_s=down_s),
        joints=both_arms("shoulder_pitch", there_and_back(0.5, end_s, -0.8, ease_s=down_s)),
    )


def bow(by: float, *, ease_s: float = 1.0, rest_s: float = 0.8, arms: float = 0.0) -> Choreography:
    """Return a bow of the trunk by `by` rad, twice, with arms that hang ahead by `arms` rad."""
    once_s = 2.0 * ease_s + rest_s
    begins = (0.5, 0.8 + once_s)
    lean: list[tuple[float, float]] = []
    ahead: list[tuple[float, float]] = []
    for begin_s in begins:
        lean += there_and_back(begin_s, begin_s + once_s, by, ease_s=ease_s)
        ahead += there_and_back(begin_s, begin_s + once_s, arms, ease_s=ease_s)
    return standing(begins[-1] + once_s + 0.6, lean=lean, joints=both_arms("shoulder_pitch", ahead))


def kick(out: float, *, lift: float, kick_s: float = 0.45, count: int = 2) -> Choreography:
    """Return kicks of the left foot, `out` m ahead of where it stood and `lift` m up."""
    raise_s = 0.5
    alone_s = raise_s + 2.0 * count * kick_s + 0.4
    lifts = [(raise_s, 0.15)]
    ways = [(raise_s, 0.0)]
    for number in range(count):
        at_s = raise_s + (2.0 * number + 1.0) * kick_s
        lifts += [(at_s, lift), (at_s + kick_s, 0.15)]
        ways += [(at_s, out), (at_s + kick_s, 0.0)]
    begin_s = 1.3
    end_s = begin_s + alone_s
    return Choreography(
        duration_s=end_s + 1.5,
        feet=NARROW,
        moves=[
            FootMove(foot=0, begin_s=begin_s, end_s=end_s, to=NARROW[0], lift=lifts, forward=ways)
        ],
        root_height=((0.3, STAND), (1.0, 0.73), (end_s + 0.3, 0.73), (end_s + 1.0, STAND)),
        joints=both_arms("shoulder_roll", there_and_back(0.2, end_s + 0.8, 0.35), mirrored=True),
    )


def reach(
    pitch: float, *, roll: float = 0.1, both: bool = False, lean: float = 0.0, low: float = STAND
) -> Choreography:
    """Return the left arm, or both, that reach twice: shoulders by `pitch` and `roll` rad, elbows stretched."""
    keys: dict[str, list[tuple[float, float]]] = {"pitch": [], "roll": [], "elbow": []}
    leans: list[tuple[float, float]] = []
    heights: list[tuple[float, float]] = []
    for begin_s in (0.5, 3.1):
        for name, by in (("pitch", pitch), ("roll", roll), ("elbow", 0.5)):
            keys[name] += there_and_back(begin_s, begin_s + 2.4, by, ease_s=0.9)
        leans += there_and_back(begin_s, begin_s + 2.4, lean, ease_s=0.9)
        way = there_and_back(begin_s, begin_s + 2.4, low - STAND, ease_s=0.9)
        heights += [(time, STAND + value) for time, value in way]
    joints = {
        **both_arms("shoulder_pitch", keys["pitch"]),
        **both_arms("shoulder_roll", keys["roll"], mirrored=True),
        **both_arms("elbow", keys["elbow"]),
    }
    if not both:
        joints = {name: own for name, own in joints.items() if name.startswith("left")}
    return standing(6.1, height=heights, lean=leans, joints=joints)


def wave(
    pitch: float, *, roll: float, beat_s: float = 0.7, count: int = 5, both: bool = False
) -> Choreography:
    """Return the left arm, or both, raised by `pitch` and `roll` rad, and a forearm that waves `count` times."""
    end_s = 1.4 + count * beat_s
    joints = {
        **both_arms("shoulder_pitch", there_and_back(0.4, end_s + 1.0, pitch, ease_s=0.9)),
        **both_arms(
            "shoulder_roll", there_and_back(0.4, end_s + 1.0, roll, ease_s=0.9), mirrored=True
        ),
        **both_arms("elbow", beats(1.3, beat_s, count, -0.6)),
    }
    if not both:
        joints = {name: own for name, own in joints.items() if name.startswith("left")}
    return standing(end_s + 1.6, joints=joints)


def dance(
    beat_s: float, *, dip: float, swing: float, twist: float = 0.0, step: float = 0.0
) -> Choreography:
    """Return eight beats: the root dips by `dip` m, arms swing by `swing` rad, the waist twists, feet step aside."""
    count = 8
    end_s = BEGIN_S + count * beat_s
    swings = beats(BEGIN_S, 2.0 * beat_s, count // 2, -swing)
    opposite = [(time + beat_s, value) for time, value in swings]
    twists = [(BEGIN_S, 0.0)]
    for number in range(count):
        twists.append((BEGIN_S + (number + 0.5) * beat_s, twist * (-1.0) ** number))
    joints: dict[str, Keys] = {
        "left_shoulder_pitch_joint": swings,
        "right_shoulder_pitch_joint": opposite,
        "waist_yaw_joint": [*twists, (end_s + 0.4, 0.0)],
        **both_arms(
            "shoulder_roll", there_and_back(0.2, end_s + 0.6, 0.25, ease_s=0.6), mirrored=True
        ),
    }
    if step:
        # To one side and back, a foot with each beat.
        aside = [(0.0, step, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, -step, 0.0)]
        steps = [*aside, *aside]
        return stepping(steps, step_s=beat_s, lift=0.06, joints=joints)
    height = [(time, STAND + value) for time, value in beats(BEGIN_S, beat_s, count, -dip)]
    return standing(end_s + 1.2, height=height, joints=joints)


Plan = Callable[[], Choreography]
KINDS: Mapping[str, Mapping[str, Plan]] = {
    "walk": {
        "slow": partial(walk, 0.1, step_s=0.62),
        "short": partial(walk, 0.14),
        "easy": partial(walk, 0.17),
        "brisk": partial(walk, 0.2),
        "curve": partial(walk, 0.16, turn=0.1),
        "bend": partial(walk, 0.14, turn=0.18),
    },
    "back": {
        "slow": partial(walk, -0.08, step_s=0.62),
        "easy": partial(walk, -0.12),
        "brisk": partial(walk, -0.17),
        "curve": partial(walk, -0.1, turn=0.1),
    },
    "turn": {
        "slow": partial(turn, 0.3, step_s=0.62),
        "easy": partial(turn, 0.4),
        "wide": partial(turn, 0.5),
        "short": partial(turn, 0.5, count=4),
    },
    "side_step": {
        "slow": partial(side_step, 0.08, step_s=0.62),
        "short": partial(side_step, 0.08),
        "easy": partial(side_step, 0.095),
        "wide": partial(side_step, 0.105),
        "once": partial(side_step, 0.09, count=2),
    },
    "march": {
        "low": partial(march, 0.06),
        "easy": partial(march, 0.09),
        "high": partial(march, 0.13),
        "slow": partial(march, 0.1, step_s=0.7),
        "arms": partial(march, 0.09, arms=-0.6),
    },
    "squat": {
        "dip": partial(squat, 0.68, cycle_s=1.4),
        "half": partial(squat, 0.62),
        "deep": partial(squat, 0.55),
        "deepest": partial(squat, 0.48, cycle_s=2.1),
        "slow": partial(squat, 0.58, cycle_s=2.8, count=2),
        "arms_down": partial(squat, 0.6, arms=-0.5),
    },
    "sit": {
        "high": partial(sit, 0.62, rest_s=1.0, lean=0.2),
        "easy": partial(sit, 0.56, rest_s=1.2, lean=0.3),
        "low": partial(sit, 0.5, rest_s=1.0, lean=0.4),
        "long": partial(sit, 0.56, rest_s=3.0, lean=0.3),
    },
    "bow": {
        "nod": partial(bow, 0.2, ease_s=0.7),
        "easy": partial(bow, 0.35),
        "deep": partial(bow, 0.5, ease_s=1.2),
        "slow": partial(bow, 0.4, ease_s=1.6, rest_s=1.2),
        "arms": partial(bow, 0.35, arms=-0.6),
    },
    "kick": {
        "low": partial(kick, 0.2, lift=0.18),
        "ahead": partial(kick, 0.3, lift=0.25),
        "high": partial(kick, 0.3, lift=0.3),
        "slow": partial(kick, 0.26, lift=0.24, kick_s=0.7),
        "thrice": partial(kick, 0.24, lift=0.21, count=3),
    },
    "reach": {
        "ahead": partial(reach, -1.3),
        "up": partial(reach, -2.4, roll=0.3),
        "aside": partial(reach, -0.4, roll=1.1),
        "both": partial(reach, -1.3, both=True),
        "both_up": partial(reach, -2.3, roll=0.3, both=True),
        "down": partial(reach, -0.9, both=True, lean=0.35, low=0.62),
    },
    "wave": {
        "easy": partial(wave, -1.6, roll=0.5),
        "high": partial(wave, -2.3, roll=0.4),
        "aside": partial(wave, -0.6, roll=1.2),
        "quick": partial(wave, -1.6, roll=0.5, beat_s=0.5, count=7),
        "both": partial(wave, -1.6, roll=0.5, both=True),
    },
    "dance": {
        "bounce": partial(dance, 0.6, dip=0.05, swing=0.6),
        "dip": partial(dance, 0.9, dip=0.12, swing=0.9),
        "twist": partial(dance, 0.7, dip=0.04, swing=0.5, twist=0.3),
        "slow": partial(dance, 1.0, dip=0.08, swing=0.7, twist=0.4),
        "aside": partial(dance, 0.6, dip=0.0, swing=0.5, step=0.05),
        "aside_twist": partial(dance, 0.66, dip=0.0, swing=0.5, twist=0.08, step=0.04),
    },
    # Named by their seeds.
    "gesture": {str(seed): partial(gesture, seed) for seed in range(GESTURES)},
}
"""The plans by kind and variant."""
REPERTOIRE: Mapping[str, Clip] = {
    f"{kind}_{variant}": Clip(description=f"{kind}, {variant}", plan=plan)
    for kind, variants in KINDS.items()
    for variant, plan in variants.items()
}
"""The clips by name."""
