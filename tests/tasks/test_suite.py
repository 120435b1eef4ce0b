"""Rewards of the tasks after dm_control's suite, at states whose values are known."""

import math

import mujoco
import pytest
import torch

from ksim_rl.tasks import control_suite, planar
from tests.tasks.placed import Placed


def close(actual, expected):
    torch.testing.assert_close(actual, torch.tensor(expected), atol=1e-5, rtol=1e-4)


def test_pendulum():
    bench = Placed("pendulum_swingup", 5)
    bench.set(
        {"hinge": [0.0, 0.1, math.pi, math.pi / 2, 0.0]}, {"hinge": [0.0, 0.0, 0.0, 0.0, 5.0]}
    )
    rated = bench.reward(control_suite.PendulumReward())
    # Level with the axle the cosine is 0, about half-way from hanging to 8 degrees from upright.
    # At 5 rad/s "slow" is 0.1.
    cosine = math.cos(math.radians(8.0))
    close(rated, [1.0, 1.0, 0.0, 1.0 / (1.0 + cosine), (1.0 + 0.4) / 5.0])


def test_the_torque_cannot_lift_the_pendulum():
    model = Placed("pendulum_swingup", 1).model
    weight_torque = 9.81 * (0.9 * 0.5 + 0.1 * 0.25)
    assert float(model.actuator_gear[0, 0]) < 0.5 * weight_torque


def test_reacher():
    bench = Placed("reacher", 3)
    # Straight along x, the finger is 0.25 m from the hub; targets on it, at its margin, and beyond the tolerated 15 mm.
    bench.set({"shoulder": 0.0, "wrist": 0.0})
    bench.driver.readings.commands["target"] = torch.tensor(
        [[0.25, 0.0], [0.25, 0.115], [0.25, 0.0149]]
    )
    close(bench.reward(control_suite.ReacherReward()), [1.0, 0.1, 1.0])


def test_reacher_targets_are_spread_evenly_over_the_ring():
    bench = Placed("reacher", 2000)
    radius_E = torch.linalg.vector_norm(bench.env.reset()["command", "target"], dim=-1)
    assert radius_E.min() >= 0.06 and radius_E.max() <= 0.22
    # Evenly by area: half of the targets lie outside of the circle that halves the ring.
    half = math.sqrt((0.06**2 + 0.22**2) / 2)
    assert (radius_E > half).float().mean().item() == pytest.approx(0.5, abs=0.05)


def test_walker():
    bench = Placed("walker_run", 4)
    # Standing still, at the full speed, at half of it, and lying on the back.
    bench.set(
        {"root_y": [0.0, 0.0, 0.0, math.pi], "root_z": [1.3, 1.3, 1.3, 1.3]},
        {"root_x": [0.0, 5.0, 2.5, 0.0]},
    )
    close(planar.forward_speed(bench.view), [0.0, 5.0, 2.5, 0.0])
    close(bench.reward(planar.WalkerReward()), [1.0, 1.0, 1.0, 0.75])
    close(bench.reward(planar.WalkerReward(speed=5.0)), [1 / 6, 1.0, 3.5 / 6, 0.75 / 6])


def test_forward_speed_is_of_the_centre_of_mass():
    bench = Placed("walker_walk", 1)
    # The legs swing forward and carry mass with them, though the torso's middle rests.
    bench.set({}, {"right_hip": -2.0, "left_hip": -1.0})
    data = mujoco.MjData(bench.model)
    data.qpos[:], data.qvel[:] = bench.world.qpos_EL[0].numpy(), bench.world.qvel_EL[0].numpy()
    mujoco.mj_forward(bench.model, data)
    mujoco.mj_subtreeVel(bench.model, data)
    expected = float(data.subtree_linvel[bench.model.body("torso").id][0])
    assert expected > 0.1
    close(planar.forward_speed(bench.view), [expected])


def test_hopper():
    bench = Placed("hopper_hop", 3)
    # In the air, upright, the leg as in the stand; then with the knee fully bent, which brings the foot up.
    bench.set({"root_y": 0.0, "root_z": 1.2, "knee": [0.8, 0.8, 2.4]}, {"root_x": [1.5, 0.75, 1.5]})
    foot = bench.view.bodies("foot").pos_EN3[:, 0, 2]
    assert foot[2] > foot[0] + 0.1
    rated = bench.reward(planar.HopperReward(speed=1.5))
    close(rated[:2], [1.0, 0.5])
    assert rated[2] < 0.9
    bench.driver.readings.action_EL = torch.tensor([[0.0] * 4, [1.0] * 4, [1.0, 1.0, 0.0, 0.0]])
    close(bench.reward(planar.HopperReward())[:2], [1.0, 0.8])


def test_cheetah():
    bench = Placed("cheetah_run", 4)
    bench.set({}, {"root_x": [-1.0, 0.0, 4.0, 12.0]})
    close(bench.reward(planar.CheetahReward()), [0.0, 0.0, 0.5, 1.0])


@pytest.mark.parametrize("name", ["walker_walk", "hopper_stand", "cheetah_run"])
def test_they_stand_on_the_ground_at_the_start(name):
    bench = Placed(name, 2)
    bench.set({})
    lowest = bench.world.geom_xpos_EL[..., 2].min().item()
    before = bench.view.joints("root_z").pos_EL.clone()
    bench.world.step(20)
    bench.world.refresh()
    bench.driver.refreshed()
    after = bench.view.joints("root_z").pos_EL
    assert lowest > -0.001
    assert (before - after).abs().max() < 0.06, (
        "they neither fall through the ground nor are thrown up"
    )
