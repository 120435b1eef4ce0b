"""Follows a reference motion through an episode: when in the motion each env is, and the motion's pose then."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.world_view import WorldView


def motion_start_time(view: WorldView, file: str) -> Float[Tensor, " E"]:
    """Return the buffer of when in the motion each episode began, s; `ResetToMotion` writes it."""
    # Zeroed at resets by the buffer itself; without `ResetToMotion` episodes follow the motion from its first
    # frame.
    return view.buffers.get(f"motion/{file}.start_s_E")


def motion_time(view: WorldView, file: str) -> Float[Tensor, " E"]:
    """Return the present time in a motion that episodes follow from where `ResetToMotion` began them, s."""
    return motion_start_time(view, file) + view.episode_time_E


def motion_clip(view: WorldView, file: str) -> Int64[Tensor, " E"] | None:
    """Return the buffer of the clip that each episode follows; `ResetToMotion` writes it. None: there is one clip."""
    # A motion that is a single file needs no buffer, and is sampled without look-ups.
    if len(view.motion(file).names) == 1:
        return None
    return view.buffers.get(f"motion/{file}.clip_E", dtype=torch.int64)


def motion_end(view: WorldView, file: str) -> Float[Tensor, "*E"]:
    """Return how long the motion is that each episode follows, s."""
    return view.motion(file).duration_of(motion_clip(view, file))


def motion_joints(
    view: WorldView, file: str, joints: Patterns
) -> tuple[Float[Tensor, "E L"], Float[Tensor, "E L"]]:
    """Return positions and velocities that joints have in the motion now; computed once per state."""
    # The key holds the patterns as they were given; other spellings are computed separately.
    key = f"motion/{file}.joints {joints}"
    if key not in view.cache:
        index = view.joints(joints).index
        view.cache[key] = view.motion(file).sample_joints(
            motion_time(view, file), index, motion_clip(view, file)
        )
    return view.cache[key]


def motion_bodies(
    view: WorldView, file: str, bodies: Patterns
) -> tuple[Float[Tensor, "E N 3"], Float[Tensor, "E N 4"]]:
    """Return the poses that bodies have in the motion now, world frame, moved by `motion_shift`; once per state."""
    key = f"motion/{file}.bodies {bodies}"
    if key not in view.cache:
        index = view.bodies(bodies).index
        shift_E3 = motion_shift(view)
        # Orientations are not shifted: origins differ in position only.
        pos_EN3, quat_EN4 = view.motion(file).sample_bodies(
            motion_time(view, file), index, motion_clip(view, file)
        )
        view.cache[key] = (pos_EN3 if shift_E3 is None else pos_EN3 + shift_E3[:, None]), quat_EN4
    return view.cache[key]


def motion_shift(view: WorldView) -> Float[Tensor, "E 3"] | None:
    """Return how far motions are moved in each env, m: to its origin, if the robot's root can go there."""
    # A fixed root stays in place, and so must its motion.
    if view.terrain.is_flat or not view.robot.free_root:
        return None
    return view.terrain.origins_E3
