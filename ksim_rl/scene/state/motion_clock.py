"""This module follows a reference motion through an episode: when in the motion each env is, and what it shows then."""

from jaxtyping import Float
from torch import Tensor

from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.world_view import WorldView


def motion_start_time(view: WorldView, file: str) -> Float[Tensor, " E"]:
    """Return the buffer of when in the motion each episode began, s; `ResetToMotion` writes it."""
    return view.buffers.get(f"motion/{file}.start_s_E")


def motion_time(view: WorldView, file: str) -> Float[Tensor, " E"]:
    """Return the present time in a motion that episodes follow from where `ResetToMotion` began them, s."""
    return motion_start_time(view, file) + view.episode_time_E


def motion_joints(
    view: WorldView, file: str, joints: Patterns
) -> tuple[Float[Tensor, "E L"], Float[Tensor, "E L"]]:
    """Return positions and velocities that joints have in the motion now; computed once per state."""
    keys = [f"motion/{file}.{part} of {joints}" for part in ("joint_pos", "joint_vel")]
    if keys[0] not in view.cache:
        sampled = view.motion(file).sample_joints(motion_time(view, file), view.joints(joints).index)
        view.cache.update(zip(keys, sampled, strict=True))
    return view.cache[keys[0]], view.cache[keys[1]]


def motion_bodies(
    view: WorldView, file: str, bodies: Patterns
) -> tuple[Float[Tensor, "E N 3"], Float[Tensor, "E N 4"]]:
    """Return the poses that bodies have in the motion now, world frame, moved by `motion_shift`; once per state."""
    keys = [f"motion/{file}.{part} of {bodies}" for part in ("body_pos", "body_quat")]
    if keys[0] not in view.cache:
        pos_EN3, quat_EN4 = view.motion(file).sample_bodies(
            motion_time(view, file), view.bodies(bodies).index
        )
        shift_E3 = motion_shift(view)
        pos_EN3 = pos_EN3 if shift_E3 is None else pos_EN3 + shift_E3[:, None]
        view.cache.update(zip(keys, (pos_EN3, quat_EN4), strict=True))
    return view.cache[keys[0]], view.cache[keys[1]]


def motion_shift(view: WorldView) -> Float[Tensor, "E 3"] | None:
    """Return how far motions are moved in each env, m: to its origin, if the robot's root can go there."""
    return None if view.terrain.is_flat or not view.robot.free_root else view.terrain.origins_E3
