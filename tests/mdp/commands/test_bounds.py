"""What a command says of its bounds holds all that it draws, and no more than that."""

import pytest
import torch

from ksim_rl import mdp
from tests.mdp.bench import FREE_BODY, Bench

E = 4000
RANGES = {"lin_vel_x": (0.2, 0.8), "lin_vel_y": (-0.5, -0.25), "ang_vel_z": (0.1, 0.6)}
ROTATION = {"roll": (-3.0, 3.0), "pitch": (-1.5, 1.5), "yaw": (-3.0, 3.0)}


def velocity(**shares):
    return mdp.UniformVelocityCommand(resampling_time_range_s=None, **RANGES, **shares)


TERMS = {
    "plain": velocity(),
    "standing": velocity(rel_standing_envs=0.2),
    "forward": velocity(rel_forward_envs=0.2, forward_min_speed=0.1),
    "heading": velocity(rel_heading_envs=0.5),
    "world": velocity(rel_world_envs=1.0),
    "fast": velocity(rel_forward_envs=0.2, forward_min_speed=1.5),
    "height": mdp.BaseHeightCommand(resampling_time_range_s=None, height=(0.2, 0.4)),
    "joints": mdp.JointPositionCommand(
        resampling_time_range_s=None, joints=("right_hip", "left_hip"), offset=(-0.2, 0.4)
    ),
    "position": mdp.CartesianCommand(
        resampling_time_range_s=None, frame="root", position={"x": (0.1, 0.3), "z": (-0.2, 0.1)}
    ),
    "pose": mdp.CartesianCommand(
        resampling_time_range_s=None,
        frame="root",
        position={"y": (0.1, 0.3)},
        orientation=ROTATION,
    ),
}


@pytest.fixture(scope="module")
def crowd():
    bench = Bench(FREE_BODY, E, {}, soft_joint_pos_limit_factor=0.5)
    # Turned by all angles about z: some commands are in the axes of the world.
    angle_E = torch.linspace(-torch.pi, torch.pi, E)
    quat_E4 = torch.zeros(E, 4)
    quat_E4[:, 0] = torch.cos(0.5 * angle_E)
    quat_E4[:, 3] = torch.sin(0.5 * angle_E)
    bench.view.world.qpos_EL[:, 3:7] = quat_E4
    bench.view.world.refresh()
    return bench


@pytest.mark.parametrize("name", TERMS)
def test_bounds_are_the_ends_of_what_is_drawn(crowd, name):
    term = TERMS[name]
    with crowd.driver.scope(f"commands/{name}"):
        term.resample(crowd.view, crowd.everybody_E)
        value_EK = term(crowd.view)
        bounds = term.bounds(crowd.view, term.ranges)
    low_K, high_K = torch.tensor(bounds).unbind(-1)
    assert len(bounds) == value_EK.shape[1]
    assert (value_EK >= low_K - 1e-6).all() and (value_EK <= high_K + 1e-6).all()
    # Of 4000 draws some are near to each end, be it a corner of two ranges; not each angle has each quaternion.
    share = 0.25 if name == "pose" else 0.06
    near_K = share * (high_K - low_K) + 1e-6
    assert (value_EK.amin(0) <= low_K + near_K).all(), (value_EK.amin(0), low_K)
    assert (value_EK.amax(0) >= high_K - near_K).all(), (value_EK.amax(0), high_K)


def test_what_is_set_from_outside_is_within_its_axes(crowd):
    term = mdp.JoystickCommand(axes={"vx": (-1.0, 0.5), "wz": (0.0, 2.0)})
    assert term.bounds(crowd.view, term.ranges) == [(-1.0, 0.5), (0.0, 2.0)]


def test_sines_and_cosines_are_between_minus_one_and_one(crowd):
    term = mdp.SinusoidalGaitCommand(frequency=(1.0, 2.0), offsets=(0.0, 0.5))
    assert term.bounds(crowd.view, term.ranges) == 4 * [(-1.0, 1.0)]


def test_nobody_knows_where_an_episode_starts(crowd):
    term = mdp.StartPoseCommand()
    assert term.bounds(crowd.view, term.ranges) is None
