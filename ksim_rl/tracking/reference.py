"""Compares a robot's bodies with a reference motion's, in the world and seen from an anchor body.

An aligned motion is moved and turned about the vertical so that its anchor stands where the robot's does, at its own
height: a robot that has drifted is not asked to jump back. That is the rule of BeyondMimic (Liao et al., 2025).
"""

from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.motion_tracking import OfMotion, OfMotionBodies
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.motion_clock import motion_bodies, motion_clip, motion_time


class Poses(NamedTuple):
    """Positions, m, and orientations (w, x, y, z) of bodies in the world."""

    pos_EN3: Float[Tensor, "E N 3"]
    quat_EN4: Float[Tensor, "E N 4"]


# Per view, the velocities of bodies in each frame of a motion, by file and bodies.
_VELOCITIES: WeakKeyDictionary[EnvView, dict[tuple[str, tuple[int, ...]], Tensor]] = (
    WeakKeyDictionary()
)


@dataclass(frozen=True, kw_only=True)
class OfAnchor(OfMotion):
    """A term of a body, the anchor, in a reference motion and on the robot."""

    anchor: str

    def wanted(self, view: EnvView) -> tuple[Float[Tensor, "E 3"], Float[Tensor, "E 4"]]:
        """Return where the anchor is in the motion, m, and its orientation there; position stage."""
        pos_EN3, quat_EN4 = motion_bodies(view, self.file, self.anchor)
        return pos_EN3[:, 0], quat_EN4[:, 0]


@dataclass(frozen=True, kw_only=True)
class OfAlignedBodies(OfAnchor, OfMotionBodies):
    """A term of bodies in a reference motion that is aligned with the robot's anchor."""

    def aligned(self, view: EnvView) -> Poses:
        """Return where the bodies are in the aligned motion; position stage, computed once per state."""
        # One computation for all terms that align the same bodies.
        key = f"motion/{self.file}.aligned {self.bodies} with {self.anchor}"
        if key not in view.cache:
            own = view.body(self.anchor)
            pos_E3, quat_E4 = self.wanted(view)
            # Yaw from the motion's anchor to the robot's: roll and pitch are to be tracked, so they stay.
            whole_turn_E4 = quaternion.multiply(own.quat_EL, quaternion.conjugate(quat_E4))
            turn_E = quaternion.yaw(whole_turn_E4)
            half_E1 = 0.5 * turn_E[:, None]
            zero_E2 = torch.zeros_like(quat_E4[:, :2])
            # Quaternion (w, 0, 0, z) of a turn about the vertical.
            turn_E4 = torch.cat((torch.cos(half_E1), zero_E2, torch.sin(half_E1)), dim=-1)
            turn_EN4 = turn_E4[:, None]
            pos_EN3, quat_EN4 = motion_bodies(view, self.file, self.bodies)
            # The robot's place on the ground and the motion's height: drift is forgiven, crouching is not.
            place_E3 = torch.cat((own.pos_EL[:, :2], pos_E3[:, 2:]), dim=-1)
            away_EN3 = pos_EN3 - pos_E3[:, None]
            placed_EN3 = place_E3[:, None] + quaternion.rotate(turn_EN4, away_EN3)
            view.cache[key] = Poses(placed_EN3, quaternion.multiply(turn_EN4, quat_EN4))
        return view.cache[key]


def motion_velocities(
    view: EnvView, file: str, bodies: Patterns
) -> tuple[Float[Tensor, "E N 3"], Float[Tensor, "E N 3"]]:
    """Return linear (m/s) and angular (rad/s) velocities that bodies have in the motion now, world frame.

    They are of the origins of the body frames, from the motion's qpos and qvel; between frames linearly.
    """
    key = f"motion/{file}.velocity of {bodies}"
    if key not in view.cache:
        motion = view.motion(file)
        table_FN6 = _velocity_table(view, file, bodies)
        low_E, share_E1 = motion.between(motion_time(view, file), motion_clip(view, file))
        share_E11 = share_E1[:, None]
        view.cache[key] = torch.lerp(table_FN6[low_E], table_FN6[low_E + 1], share_E11)
    return view.cache[key][..., :3], view.cache[key][..., 3:]


def _velocity_table(view: EnvView, file: str, bodies: Patterns) -> Tensor:
    tables = _VELOCITIES.setdefault(view, {})
    key = (file, view.bodies(bodies).ids)
    if key not in tables:
        motion = view.motion(file)
        model = view.world.mj_model
        # Once per view: the C engine steps through all frames on the host.
        qpos_FL = motion.qpos_FL.cpu().numpy()
        qvel_FM = motion.qvel_FL.cpu().numpy()
        found_FN6 = body_velocities(model, qpos_FL, qvel_FM, key[1])
        # Outside of inference mode: the table outlives the mode of the call that happens to come first.
        with torch.inference_mode(False):
            tables[key] = torch.tensor(found_FN6, dtype=torch.float32, device=view.device)
    return tables[key]


def body_velocities(
    mj_model: mujoco.MjModel,
    qpos_FL: Float[np.ndarray, "F L"],
    qvel_FM: Float[np.ndarray, "F M"],
    bodies: tuple[int, ...],
) -> Float[np.ndarray, "F N 6"]:
    """Return linear, then angular velocities of body frames, world axes, m/s and rad/s, by the C engine."""
    data = mujoco.MjData(mj_model)
    found_FN6 = np.zeros((len(qpos_FL), len(bodies), 6))
    turn_and_move = np.empty(6)
    for frame, (qpos, qvel) in enumerate(zip(qpos_FL, qvel_FM, strict=True)):
        data.qpos[:] = qpos
        data.qvel[:] = qvel
        # All that mj_objectVelocity reads.
        mujoco.mj_kinematics(mj_model, data)
        mujoco.mj_comPos(mj_model, data)
        mujoco.mj_comVel(mj_model, data)
        for place, body in enumerate(bodies):
            mujoco.mj_objectVelocity(
                mj_model, data, mujoco.mjtObj.mjOBJ_XBODY, body, turn_and_move, 0
            )
            # From (angular, linear) to (linear, angular).
            found_FN6[frame, place] = np.roll(turn_and_move, 3)
    return found_FN6
