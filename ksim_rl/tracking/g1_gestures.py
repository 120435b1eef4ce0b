"""Random gestures of Unitree G1: arms, waist and height move from one drawn pose to the next, feet stay.

They show a policy that follows many motions how joints move together. Targets are drawn in joint space, and none is
the target of a hand: motions that reach for something are no part of them.
"""

from collections.abc import Mapping

import numpy as np

from ksim_rl.scene.robots.unitree_g1 import SIDES
from ksim_rl.tracking.g1_motions import FEET, STAND
from ksim_rl.tracking.keyframes import Choreography

POSES = 6
"""That a gesture goes through before it returns to the default pose."""
LEAST_S = 0.7
"""s from one pose to the next at least."""
SPEED = 1.9
"""rad/s, of the joint that moves furthest, in the mean from pose to pose."""
BEGIN_S = 0.5
REST_S = 0.6
"""s before the first pose, and behind the last one."""
LOW = 0.58
"""m: the lowest root."""
LEAN_OF_DEPTH = 1.1
"""rad by which the trunk leans ahead for each metre that the root is lower, as people squat."""
ARM: Mapping[str, tuple[float, float]] = {
    "shoulder_pitch": (-2.4, 0.4),
    "shoulder_roll": (0.1, 1.2),
    "shoulder_yaw": (-0.6, 0.6),
    "elbow": (-0.9, 0.8),
    "wrist_roll": (-0.6, 0.6),
    "wrist_pitch": (-0.4, 0.4),
    "wrist_yaw": (-0.4, 0.4),
}
"""rad off the default pose, of the left arm: negative pitches raise it, positive rolls hold it off the trunk, and
positive elbows stretch it. Rolls and yaws of the right arm are negated."""
WAIST: Mapping[str, tuple[float, float]] = {
    "waist_yaw": (-0.5, 0.5),
    "waist_roll": (-0.15, 0.15),
}
LEAN = (-0.08, 0.3)
"""rad by which the trunk leans ahead, beside the lean of its depth."""


def gesture(seed: int) -> Choreography:
    """Return a gesture through `POSES` random poses; both arms are drawn apart from each other."""
    random = np.random.default_rng(seed)
    ranges = _ranges()
    low_P, high_P = np.array(list(ranges.values())).T
    time_s = BEGIN_S
    pose_P = np.zeros(len(ranges))
    keys: dict[str, list[tuple[float, float]]] = {name: [(time_s, 0.0)] for name in ranges}
    for number in range(POSES + 1):
        next_P = random.uniform(low_P, high_P)
        # Who is lower leans further ahead, so that the weight stays over the feet.
        next_P[1] += LEAN_OF_DEPTH * next_P[0]
        if number == POSES:
            # Back to the default pose.
            next_P[:] = 0.0
        furthest = float(np.abs(next_P - pose_P).max())
        time_s += max(LEAST_S, furthest / SPEED)
        pose_P = next_P
        for name, value in zip(ranges, pose_P, strict=True):
            keys[name].append((time_s, float(value)))
    depths = keys.pop("depth")
    return Choreography(
        duration_s=time_s + REST_S,
        feet=FEET,
        root_height=[(time, STAND - depth) for time, depth in depths],
        lean=keys.pop("lean"),
        joints=keys,
    )


def _ranges() -> dict[str, tuple[float, float]]:
    """Return the ranges of all that is drawn: the depth of the root first, then the lean, then joints by name."""
    ranges = {"depth": (0.0, STAND - LOW), "lean": LEAN}
    for name, around in WAIST.items():
        ranges[f"{name}_joint"] = around
    for side in SIDES:
        for name, (low, high) in ARM.items():
            # Rolls and yaws of the right arm have the other sign.
            if side == "right" and name.endswith(("roll", "yaw")):
                ranges[f"{side}_{name}_joint"] = (-high, -low)
            else:
                ranges[f"{side}_{name}_joint"] = (low, high)
    return ranges
