"""Measures how feasible a motion is for a two-legged robot: the ground's pressure point, and the motors' torques."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from ksim_rl.scene.motions.frames import in_each_frame
from ksim_rl.tracking.dynamics import GRAVITY, Demand, demand, self_contacts
from ksim_rl.tracking.keyframes import Figure

Array = np.ndarray
# m: half of a sole's length and width, less than the contact capsules of G1 have.
SOLE = (0.09, 0.025)
# Of the robot's weight: outside of them it jumps or lands hard.
LEAST_PUSH = 0.7
MOST_PUSH = 1.3
MOST_FRICTION = 0.3
MOST_TORQUE = 0.6
LEAST_ROOM = 0.002
MOST_SLIP = 0.01
# m: soles of a recording are no higher than this while they stand, and no faster than this, m/s.
STANDING_HEIGHT = 0.03
STANDING_SPEED = 0.25


@dataclass(frozen=True, kw_only=True)
class Feasibility:
    """The demands of a motion, each the worst of its frames.

    Attributes:
        off_sole: m by which the zero-moment point lies outside of the soles that stand, and the line between them.
        unsupported: share of frames in which no foot stands.
        least_push, most_push: vertical force of the ground, in weights of the robot.
        friction: horizontal force of the ground, relative to the vertical one.
        torque: share of the motors' limits.
        range_room: rad or m that joints stay inside of their ranges.
        slip: m/s of soles that stand.
        touches: parts of the robot that run into each other, and from which frame on.
    """

    off_sole: float
    unsupported: float
    least_push: float
    most_push: float
    friction: float
    torque: float
    range_room: float
    slip: float
    touches: tuple[str, ...]

    def faults(self) -> list[str]:
        """Return a line for each thing that the robot cannot do; none for a feasible motion."""
        found = []
        if self.off_sole > 0.0:
            found.append(
                f"the zero-moment point is {100 * self.off_sole:.1f} cm outside of the soles"
            )
        if self.unsupported > 0.0:
            found.append(f"no foot stands in {self.unsupported:.1%} of the frames")
        if self.least_push < LEAST_PUSH or self.most_push > MOST_PUSH:
            found.append(
                f"the ground pushes with {self.least_push:.2f} to {self.most_push:.2f} weights, beyond "
                f"{LEAST_PUSH:g} to {MOST_PUSH:g}"
            )
        if self.friction > MOST_FRICTION:
            found.append(f"it needs friction of {self.friction:.2f}, more than {MOST_FRICTION:g}")
        if self.torque > MOST_TORQUE:
            found.append(
                f"a motor gives {self.torque:.0%} of its torque, more than {MOST_TORQUE:.0%}"
            )
        if self.range_room < LEAST_ROOM:
            found.append(f"a joint leaves its range by {LEAST_ROOM - self.range_room:.3f} rad")
        if self.slip > MOST_SLIP:
            found.append(f"a standing foot slips at {self.slip:.2f} m/s")
        if self.touches:
            found.append(f"it touches itself in {len(self.touches)} places: {self.touches[0]}")
        return found


def feasibility(
    mj_model: mujoco.MjModel,
    qpos_FL: Float[Array, "F L"],
    fps: float,
    *,
    figure: Figure,
    planted_FN: Bool[Array, "F N"] | None = None,
    level_FN: Float[Array, "F N"] | None = None,
) -> Feasibility:
    """Return the demands of a motion of a robot that is alone in its model.

    `planted_FN` says which of the feet stand; None: those whose soles are low and slow. `level_FN` says on what height
    they stand, m; None: on the ground.
    """
    soles_FN3, heading_FN = _soles(mj_model, qpos_FL, figure)
    speed_FN = np.linalg.norm(np.gradient(soles_FN3, 1.0 / fps, axis=0), axis=-1)
    is_low_FN = soles_FN3[..., 2] < figure.sole_z + STANDING_HEIGHT
    standing_FN = is_low_FN & (speed_FN < STANDING_SPEED)
    if planted_FN is not None:
        standing_FN = planted_FN
    asked = demand(
        mj_model, qpos_FL, fps, feet=figure.feet, planted_FN=standing_FN, level_FN=level_FN
    )
    weight = float(mj_model.body_subtreemass[1]) * GRAVITY
    push_F = asked.force_F3[:, 2]
    aside_F = np.linalg.norm(asked.force_F3[:, :2], axis=-1)
    joints = mj_model.actuator_trnid[:, 0]
    torque_FK = np.abs(asked.torque_FM[:, mj_model.jnt_dofadr[joints] - 6])
    low_L, high_L = mj_model.jnt_range[1:].T
    room_FL = np.minimum(qpos_FL[:, 7:] - low_L, high_L - qpos_FL[:, 7:])
    # Between two frames in which it stands, as a foot comes to rest in the first of them.
    still_FN = standing_FN[:-1] & standing_FN[1:]
    slip_FN = np.linalg.norm(np.diff(soles_FN3, axis=0), axis=-1) * fps
    return Feasibility(
        off_sole=_off_sole(asked, soles_FN3, heading_FN, standing_FN),
        unsupported=float((~standing_FN.any(1)).mean()),
        least_push=float(push_F.min() / weight),
        most_push=float(push_F.max() / weight),
        friction=float((aside_F / np.maximum(push_F, 1e-9)).max()),
        torque=float((torque_FK / mj_model.actuator_forcerange[:, 1]).max()),
        range_room=float(room_FL.min()),
        slip=float(slip_FN[still_FN].max(initial=0.0)),
        touches=tuple(self_contacts(mj_model, qpos_FL)),
    )


def _soles(mj_model: mujoco.MjModel, qpos_FL: Array, figure: Figure) -> tuple[Array, Array]:
    """Return where the middles of the soles are, m, and the headings of the feet, rad, in each frame."""
    places = []
    headings = []
    for data in in_each_frame(mj_model, qpos_FL):
        sites = [data.site(foot) for foot in figure.feet]
        places.append([site.xpos.copy() for site in sites])
        # Of the x axis, the first column of the site's rotation.
        headings.append([np.arctan2(site.xmat[3], site.xmat[0]) for site in sites])
    return np.array(places), np.array(headings)


def _off_sole(asked: Demand, soles_FN3: Array, heading_FN: Array, planted_FN: Array) -> float:
    """Return how far the zero-moment point leaves the soles that stand, m; 0 where none stands."""
    worst = 0.0
    for zmp_2, soles_N3, heading_N, planted_N in zip(
        asked.zmp_F2, soles_FN3, heading_FN, planted_FN, strict=True
    ):
        feet_N2 = soles_N3[planted_N, :2]
        if not len(feet_N2):
            continue
        heading_N = heading_N[planted_N]
        line_2 = feet_N2[-1] - feet_N2[0]
        from_first_2 = zmp_2 - feet_N2[0]
        # The nearest place on the line between the feet, or the one foot.
        share = np.clip(from_first_2 @ line_2 / max(line_2 @ line_2, 1e-9), 0.0, 1.0)
        heading = heading_N[0] + share * (heading_N[-1] - heading_N[0])
        away_2 = from_first_2 - share * line_2
        ahead = abs(np.cos(heading) * away_2[0] + np.sin(heading) * away_2[1])
        aside = abs(np.cos(heading) * away_2[1] - np.sin(heading) * away_2[0])
        worst = max(worst, ahead - SOLE[0], aside - SOLE[1])
    return worst
