"""Quaternion algebra against MuJoCo's own."""

import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.scene import quaternion


@pytest.fixture(scope="module")
def pairs():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(2, 50, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True), rng.normal(size=(50, 3))


def test_multiply_is_mju_mulquat(pairs):
    (a, b), _ = pairs
    expected = np.zeros((50, 4))
    for i in range(50):
        mujoco.mju_mulQuat(expected[i], a[i], b[i])
    torch.testing.assert_close(
        quaternion.multiply(torch.tensor(a), torch.tensor(b)), torch.tensor(expected)
    )


def test_rotate_is_mju_rotvecquat_and_its_inverse_undoes_it(pairs):
    (q, _), v = pairs
    expected = np.zeros((50, 3))
    for i in range(50):
        mujoco.mju_rotVecQuat(expected[i], v[i], q[i])
    rotated = quaternion.rotate(torch.tensor(q), torch.tensor(v))
    torch.testing.assert_close(rotated, torch.tensor(expected))
    torch.testing.assert_close(quaternion.rotate_inverse(torch.tensor(q), rotated), torch.tensor(v))
    torch.testing.assert_close(
        quaternion.rotate(quaternion.conjugate(torch.tensor(q)), rotated), torch.tensor(v)
    )


def test_euler_angles_compose_as_mju_euler2quat_xyz():
    angles = np.array([0.3, -0.7, 2.1])
    expected = np.zeros(4)
    mujoco.mju_euler2Quat(expected, angles[::-1].copy(), "zyx")
    actual = quaternion.from_euler_xyz(*(torch.tensor(a) for a in angles))
    torch.testing.assert_close(actual, torch.tensor(expected))


def test_yaw_is_the_heading_of_the_x_axis(pairs):
    (q, _), _ = pairs
    x_axis = quaternion.rotate(
        torch.tensor(q), torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(50, 3)
    )
    torch.testing.assert_close(
        quaternion.yaw(torch.tensor(q)), torch.atan2(x_axis[:, 1], x_axis[:, 0])
    )


def test_wrap_to_pi():
    angles = torch.tensor([0.0, math.pi + 0.1, -math.pi - 0.1, 7.0])
    expected = torch.atan2(torch.sin(angles), torch.cos(angles))
    torch.testing.assert_close(quaternion.wrap_to_pi(angles), expected)


def test_angle_between_is_the_length_of_mju_subquat(pairs):
    (a, b), _ = pairs
    difference, expected = np.zeros(3), np.zeros(50)
    for i in range(50):
        mujoco.mju_subQuat(difference, a[i], b[i])
        expected[i] = np.linalg.norm(difference)
    a, b, expected = torch.tensor(a), torch.tensor(b), torch.tensor(expected)
    torch.testing.assert_close(quaternion.angle_between(a, b), expected)
    torch.testing.assert_close(quaternion.angle_between(a, -b), expected)
    assert quaternion.angle_between(a, -a).abs().max() < 1e-7
    # A thousandth of a degree is still seen in float32.
    small = math.radians(1e-3)
    tilted = torch.tensor([math.cos(small / 2), math.sin(small / 2), 0.0, 0.0])
    angle = quaternion.angle_between(tilted, torch.tensor([1.0, 0.0, 0.0, 0.0]))
    assert angle.item() == pytest.approx(small, rel=1e-3)
