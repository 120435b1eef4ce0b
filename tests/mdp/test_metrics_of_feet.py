import math

import torch

from ksim_rl import mdp
from tests.mdp.bench import Plateau

REST = [(0, 0, 0.1, 1, 0, 0, 0, 1, 0, 0.1, 1, 0, 0, 0)]


def settled(boxes, qvel=0.0):
    boxes.place(qpos=REST, qvel=torch.zeros(12))
    boxes.step(100)
    boxes.place(qvel=qvel)


def test_slip_is_the_speed_of_the_feet_that_touch(boxes):
    slip = mdp.FootSlipSpeed(sensor="touch", sites=("a", "b"))
    boxes.read(slip, "metrics/x")
    settled(boxes, (0.3, 0.4, 0, 0, 0, 0, 0.1, 0, 0, 0, 0, 0))
    boxes.step(1)
    torch.testing.assert_close(boxes.read(slip, "metrics/x"), torch.full((2,), 0.3))
    settled(boxes)
    boxes.place(
        qpos=(0, 0, 0.0999, 1, 0, 0, 0, 1, 0, 2.0, 1, 0, 0, 0),
        qvel=(0.3, 0.4, 0, 0, 0, 0, 3.0, 0, 0, 0, 0, 0),
    )
    boxes.step(1)
    torch.testing.assert_close(
        boxes.read(slip, "metrics/x"), torch.full((2,), 0.5), msg="b is in the air"
    )
    boxes.place(qpos=(0, 0, 2.0, 1, 0, 0, 0, 1, 0, 2.0, 1, 0, 0, 0), qvel=1.0)
    boxes.step(10)
    assert boxes.read(slip, "metrics/x").tolist() == [0.0, 0.0]


def test_the_peak_force_is_the_weight_of_the_heaviest_box_at_rest(boxes):
    settled(boxes)
    boxes.step(10)
    torch.testing.assert_close(
        boxes.read(mdp.PeakContactForce(sensor="touch"), "metrics/x"),
        torch.full((2,), 30.0),
        atol=0.1,
        rtol=0,
    )
    assert mdp.PeakContactForce(sensor="touch").reduce == "max"


def test_the_peak_height_is_that_of_the_highest_foot_above_the_ground(free_body):
    # Legs of 0.4 m; the left one is lifted by 60 degrees.
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, math.radians(60), 0))
    term = mdp.PeakFootHeight(sites=".*_foot")
    torch.testing.assert_close(free_body.read(term, "metrics/x"), torch.full((3,), 0.8))
    free_body.driver.ground = Plateau(3, free_body.view.device)
    free_body.refresh()
    torch.testing.assert_close(free_body.read(term, "metrics/x"), torch.full((3,), 0.55))
