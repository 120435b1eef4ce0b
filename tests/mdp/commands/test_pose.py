import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.mdp.commands.pose import target_pose_w
from tests.mdp.bench import FREE_BODY, Bench
from tests.mdp.recorder import Recorder

E = 2000
SOMETIMES = (3.0, 8.0)
# Turned by 90 degrees about z, at (1, 2, 3).
TURNED = (1, 2, 3, math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4), 0.1, 0.2)


@pytest.fixture(scope="module")
def crowd():
    return Bench(FREE_BODY, E, {}, soft_joint_pos_limit_factor=0.5)


def draw(bench, term, mask_E=None, scope="commands/x"):
    with bench.driver.scope(scope):
        term.resample(bench.view, bench.everybody_E if mask_E is None else mask_E)
        return term(bench.view)


def drawn(bench, term, scope="commands/x", env_index=1):
    recorder = Recorder()
    with bench.driver.scope(scope):
        term.draw_debug(bench.view, recorder, env_index)
    return recorder.drawn


def is_even(value_E, low, high):
    assert low <= value_E.min() and value_E.max() <= high
    # The mean of n uniform draws has the standard error (high - low) / sqrt(12 n).
    assert abs(float(value_E.mean()) - (low + high) / 2) < 4.0 * (high - low) / math.sqrt(
        12 * len(value_E)
    )


def test_heights_fill_their_range(crowd):
    value_E1 = draw(
        crowd,
        mdp.BaseHeightCommand(resampling_time_range_s=SOMETIMES, height=(0.2, 0.4)),
        scope="c/h",
    )
    assert value_E1.shape == (E, 1)
    is_even(value_E1[:, 0], 0.2, 0.4)


def test_joint_targets_are_offsets_from_the_default_within_the_soft_limits(crowd):
    term = mdp.JointPositionCommand(
        resampling_time_range_s=SOMETIMES, joints=("right_hip", "left_hip"), offset=(-0.2, 0.1)
    )
    right_E, left_E = draw(crowd, term, scope="c/j").unbind(-1)
    # Half of the ranges (0, 2) and (-1, 1) about their middles; the defaults are 0.5 and 0.25.
    assert right_E.min() == 0.5 and right_E.max() <= 0.6
    assert float((right_E == 0.5).float().mean()) == pytest.approx(2 / 3, abs=0.05)
    is_even(left_E, 0.05, 0.35)


def test_a_cartesian_target_stays_in_the_frame_that_it_was_drawn_in(crowd):
    position = {"x": (0.5, 0.5), "z": (-1.0, 1.0)}
    for frame in ("root", "world"):
        term = mdp.CartesianCommand(
            resampling_time_range_s=SOMETIMES, position=position, frame=frame
        )
        crowd.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0))
        before_E3 = draw(crowd, term, scope=f"c/{frame}").clone()
        assert (before_E3[:, 0] == 0.5).all() and (before_E3[:, 1] == 0.0).all()
        is_even(before_E3[:, 2], -1.0, 1.0)
        crowd.place(qpos=TURNED)
        with crowd.driver.scope(f"c/{frame}"):
            assert torch.equal(term(crowd.view), before_E3)
        pos_E3, quat_E4 = target_pose_w(crowd.view, before_E3, frame=frame)
        assert quat_E4 is None
        expected_E3 = before_E3
        if frame == "root":  # x of the root is y of the world
            expected_E3 = torch.tensor([1.0, 2.5, 3.0]) + before_E3 * torch.tensor([0.0, 0.0, 1.0])
        torch.testing.assert_close(pos_E3, expected_E3, atol=1e-5, rtol=0)


def test_a_cartesian_orientation_is_that_of_mujocos_euler_angles(free_body):
    angles = (0.4, -0.7, 1.1)
    term = mdp.CartesianCommand(
        resampling_time_range_s=SOMETIMES,
        position={"x": (0.3, 0.3)},
        orientation={
            axis: (angle, angle)
            for axis, angle in zip(("roll", "pitch", "yaw"), angles, strict=True)
        },
    )
    target_E7 = draw(free_body, term)
    expected = np.zeros(4)
    mujoco.mju_euler2Quat(expected, np.array(angles), "XYZ")  # about fixed axes
    assert target_E7[0].tolist() == pytest.approx([0.3, 0.0, 0.0, *expected], abs=1e-6)

    free_body.place(qpos=TURNED)
    _, quat_E4 = target_pose_w(free_body.view, target_E7, frame="root")
    product = np.zeros(4)
    mujoco.mju_mulQuat(product, np.array(TURNED[3:7]), expected)
    assert quat_E4 is not None and quat_E4[2].tolist() == pytest.approx(list(product), abs=1e-6)


def test_the_distance_to_a_target_is_that_of_the_named_point(free_body):
    free_body.place(qpos=TURNED)
    free_body.driver.readings.commands["reach"] = torch.tensor(
        [[0.3, 0.0, 0.0], [0.3, 0.4, 0.0], [0.0, 0.0, 0.0]]
    )
    # The site "imu" is 0.3 m ahead of the trunk's frame.
    imu_E = mdp.OffsetToCommand(command="reach", site="imu").distance(free_body.view)
    torch.testing.assert_close(imu_E, torch.tensor([0.0, 0.4, 0.3]), atol=1e-5, rtol=0)
    trunk_E = mdp.OffsetToCommand(command="reach", body="trunk").distance(free_body.view)
    torch.testing.assert_close(trunk_E, torch.tensor([0.3, 0.5, 0.0]), atol=1e-5, rtol=0)


def test_the_start_pose_stays_when_the_robot_moves(free_body):
    term = mdp.StartPoseCommand()
    free_body.place(qpos=TURNED)
    before_E7 = draw(free_body, term).clone()
    assert before_E7[0].tolist() == pytest.approx(list(TURNED[:7]), abs=1e-6)
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0))
    with free_body.driver.scope("commands/x"):
        assert torch.equal(term(free_body.view), before_E7)
    only_first = torch.tensor([True, False, False])
    after_E7 = draw(free_body, term, only_first)
    assert after_E7[0].tolist() == [0, 0, 1, 1, 0, 0, 0]
    assert torch.equal(after_E7[1:], before_E7[1:])


@pytest.mark.parametrize(
    "term",
    [
        mdp.BaseHeightCommand(resampling_time_range_s=SOMETIMES, height=(0.2, 0.4)),
        mdp.JointPositionCommand(
            resampling_time_range_s=SOMETIMES, joints=".*", offset=(-0.1, 0.1)
        ),
        mdp.CartesianCommand(
            resampling_time_range_s=SOMETIMES,
            position={"x": (0.0, 1.0)},
            orientation={"yaw": (0.0, 1.0)},
        ),
    ],
    ids=lambda term: type(term).__name__,
)
def test_resampling_some_rows_leaves_the_others_bit_identical(crowd, term):
    scope = f"some/{type(term).__name__}"
    before = draw(crowd, term, scope=scope).clone()
    mask_E = torch.arange(E) % 3 == 0
    crowd.view.step_count.add_(1)
    after = draw(crowd, term, mask_E, scope=scope)
    assert torch.equal(after[~mask_E], before[~mask_E])
    assert (after[mask_E] != before[mask_E]).any(-1).float().mean() > 0.9


def test_each_draws_what_it_asks_for(free_body):
    free_body.place(qpos=TURNED)
    height = mdp.BaseHeightCommand(resampling_time_range_s=SOMETIMES, height=(0.4, 0.4))
    draw(free_body, height, scope="d/h")
    ((kind, center),) = drawn(free_body, height, scope="d/h")
    assert kind == "sphere" and list(center) == pytest.approx([1.0, 2.0, 0.4])

    joints = mdp.JointPositionCommand(
        resampling_time_range_s=SOMETIMES, joints="right_hip", offset=(0.1, 0.1)
    )
    draw(free_body, joints, scope="d/j")
    ((kind, qpos),) = drawn(free_body, joints, scope="d/j")
    assert kind == "ghost" and list(qpos) == pytest.approx([*TURNED[:7], 0.1, 0.6], abs=1e-6)

    reach = mdp.CartesianCommand(
        resampling_time_range_s=SOMETIMES,
        position={"x": (0.5, 0.5)},
        orientation={"yaw": (math.pi / 2, math.pi / 2)},
    )
    draw(free_body, reach, scope="d/c")
    (_, center), (_, origin, axes) = drawn(free_body, reach, scope="d/c")
    assert list(center) == pytest.approx([1.0, 2.5, 3.0], abs=1e-5) and list(origin) == list(center)
    # 90 degrees of the root and 90 of the target: x points to world -x, y to -y.
    np.testing.assert_allclose(axes, np.diag([-1.0, -1.0, 1.0]), atol=1e-6)

    start = mdp.StartPoseCommand()
    draw(free_body, start, scope="d/s")
    ((kind, origin, axes),) = drawn(free_body, start, scope="d/s")
    assert kind == "frame" and list(origin) == pytest.approx([1.0, 2.0, 3.0])
    np.testing.assert_allclose(axes[:, 0], [0.0, 1.0, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: mdp.BaseHeightCommand(resampling_time_range_s=SOMETIMES, height=(0.4, 0.2)),
            "height",
        ),
        (
            lambda: mdp.CartesianCommand(resampling_time_range_s=None, position={"yaw": (0, 1)}),
            "position key 'yaw'.*x, y, z",
        ),
        (
            lambda: mdp.CartesianCommand(
                resampling_time_range_s=None, position={}, orientation={"x": (0, 1)}
            ),
            "orientation key 'x'.*pitch, roll, yaw",
        ),
        (
            lambda: mdp.CartesianCommand(resampling_time_range_s=None, position={}, frame="body"),  # pyright: ignore
            "frame='body'",
        ),
    ],
)
def test_what_does_not_fit_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
