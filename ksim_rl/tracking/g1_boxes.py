"""Motions of Unitree G1 with boxes on the ground: onto a step and back down, and sitting on a seat and rising.

A scene is the same for all clips of a set, and a box would be in the way of motions on flat ground: these clips have
tasks of their own, `g1_track_step` and `g1_track_sit`, whose scenes have the box. `python -m
ksim_rl.tracking.g1_boxes FOLDER` writes their files again.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ksim_rl.clips.motion_file import write_motion
from ksim_rl.scene.terrains import GroundBox
from ksim_rl.tracking.feasibility import Feasibility, feasibility
from ksim_rl.tracking.g1_motions import FIGURE, FPS, MIDDLE, NARROW, STAND, model
from ksim_rl.tracking.g1_repertoire import both_arms, sit
from ksim_rl.tracking.keyframes import Choreography, FootMove, Keys, foot_paths, perform

STEP = GroundBox(pos=(0.305, 0.0), size=(0.3, 1.0, 0.08))
"""The step begins 2 cm before the toes of a robot that stands at the origin."""
SEAT = GroundBox(pos=(-0.24, 0.0), size=(0.34, 0.5, 0.27))
"""The seat begins behind the heels, and is as high as pelvis and hips are in the deepest part of the motion."""
CLEAR = 0.07
"""m that a foot is lifted above the higher one of its two places."""


def step_box() -> Choreography:
    """Return steps of the left and then the right foot up onto `STEP`, and of the right and the left one back down."""
    swing_s = 1.0
    both_s = 0.8
    low = 0.7
    on_x = STEP.pos[0] - 0.5 * STEP.size[0] + 0.1
    height = STEP.size[2]
    # Foot, x and height of each step.
    steps = ((0, on_x, height), (1, on_x, height), (1, MIDDLE, 0.0), (0, MIDDLE, 0.0))
    at = [(MIDDLE, 0.0), (MIDDLE, 0.0)]
    moves = []
    ends = []
    begin_s = 1.2
    for foot, x, up in steps:
        moves.append(_over_the_edge(foot, at[foot], (x, up), begin_s=begin_s, swing_s=swing_s))
        at[foot] = (x, up)
        ends.append(begin_s + swing_s)
        begin_s += swing_s + both_s
    first_on, both_on, first_off, both_off = ends
    # The body rises while the second foot comes up, and sinks before the first one goes down.
    root: Keys = (
        (0.2, STAND),
        (0.9, low),
        (first_on, low + 0.04),
        (both_on + 0.1, low + height),
        (first_off - swing_s - 0.2, low + height),
        (first_off, low + 0.04),
        (both_off + 0.1, low),
        (both_off + 0.8, STAND),
    )
    arms_off: Keys = ((0.2, 0.0), (0.9, 0.2), (both_off, 0.2), (both_off + 0.7, 0.0))
    return Choreography(
        duration_s=both_off + 1.4,
        feet=NARROW,
        moves=moves,
        root_height=root,
        lean=((0.2, 0.0), (0.9, 0.08), (both_off, 0.08), (both_off + 0.7, 0.0)),
        joints=both_arms("shoulder_roll", arms_off, mirrored=True),
    )


def _over_the_edge(
    foot: int,
    start: tuple[float, float],
    end: tuple[float, float],
    *,
    begin_s: float,
    swing_s: float,
) -> FootMove:
    """Return a step between two places (x, height) that goes up, then ahead or back, and then down."""
    share = 0.3
    # How much of the way the path itself has gone after this share of the time.
    gone = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    way = end[0] - start[0]
    rise = end[1] - start[1]
    top = max(start[1], end[1]) + CLEAR
    # Toes point down behind the body, where the shin leans ahead: at the begin ahead, at the end back.
    at_begin, at_end = (0.4, 0.0) if way > 0.0 else (0.0, 0.4)
    early_s = share * swing_s
    late_s = (1.0 - share) * swing_s
    return FootMove(
        foot=foot,
        begin_s=begin_s,
        end_s=begin_s + swing_s,
        to=(end[0], NARROW[foot][1], 0.0),
        up=end[1],
        lift=(
            (early_s, top - start[1] - gone * rise),
            (late_s, top - start[1] - (1.0 - gone) * rise),
        ),
        pitch=((early_s, at_begin), (late_s, at_end)),
        # It waits before the edge.
        forward=((early_s, -0.6 * gone * way), (late_s, 0.6 * gone * way)),
    )


def sit_down() -> Choreography:
    """Return sitting down until pelvis and hips are at `SEAT`, a rest there, and rising; balanced without the seat."""
    return sit(0.42, rest_s=1.5, lean=0.5)


@dataclass(frozen=True, kw_only=True)
class BoxClip:
    """A motion with a box: `description` one line, and the time in which weight moves between feet."""

    description: str
    plan: Callable[[], Choreography]
    box: GroundBox
    shift_s: float = 0.6


BOX_CLIPS: Mapping[str, BoxClip] = {
    "g1_step": BoxClip(description="steps onto a box and back down", plan=step_box, box=STEP),
    "g1_sit": BoxClip(description="sits down on a seat and rises", plan=sit_down, box=SEAT),
}
"""The motions by the name of their file."""


def made(name: str) -> tuple[Float[np.ndarray, "F L"], Feasibility]:
    """Return the qpos of a motion of `BOX_CLIPS`, 50 frames per second, and how feasible it is."""
    clip = BOX_CLIPS[name]
    plan = clip.plan()
    robot = model()
    qpos_FL, _, planted_FN = perform(robot, FIGURE, plan, fps=FPS, shift_s=clip.shift_s)
    paths_FN5, _ = foot_paths(plan, np.arange(len(qpos_FL)) / FPS)
    found = feasibility(
        robot, qpos_FL, FPS, figure=FIGURE, planted_FN=planted_FN, level_FN=paths_FN5[:, :, 2]
    )
    return qpos_FL, found


if __name__ == "__main__":
    for name in BOX_CLIPS:
        write_motion(Path(sys.argv[1]) / f"{name}.npz", model(), made(name)[0], FPS)
