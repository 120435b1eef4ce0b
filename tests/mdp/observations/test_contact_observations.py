import math

import pytest
import torch

from ksim_rl import mdp
from ksim_rl.scene.sensors import ContactSensor
from tests.mdp.bench import Plateau

HALF = math.sqrt(0.5)
ROLL_90 = (HALF, HALF, 0.0, 0.0)

BLOCK_UNDER_CEILING = """
<mujoco>
  <option timestep="0.002" gravity="0 0 10"/>
  <worldbody>
    <body name="ceiling"><geom type="plane" size="0 0 0.01" pos="0 0 1" zaxis="0 0 -1"/></body>
    <body pos="0 0 0.9"><freejoint/><geom name="a" type="box" size="0.1 0.1 0.1" mass="3"/></body>
  </worldbody>
</mujoco>
"""


def close(value, expected, atol=1e-5):
    torch.testing.assert_close(value, torch.as_tensor(expected).expand_as(value), atol=atol, rtol=0)


def test_foot_height_follows_the_leg_and_the_ground(free_body):
    angle = 0.6
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, angle, 0))
    term = mdp.FootHeight(sites=("left_foot", "right_foot"))
    close(free_body.read(term), [1.0 - 0.4 * math.cos(angle), 0.6])
    free_body.driver.ground = Plateau(3, free_body.view.device)
    free_body.refresh()
    close(free_body.read(term), [0.75 - 0.4 * math.cos(angle), 0.35])


def test_foot_position_in_the_roots_frame(free_body):
    # The hip stands 0.2 m to the left; a leg turned by +90 degrees about y points to -x, which is -x of the root.
    free_body.place(qpos=(5, 6, 1, HALF, 0, 0, HALF, math.pi / 2, 0))
    close(free_body.read(mdp.FootPos(sites="left_foot")), [-0.4, 0.2, 0.0])
    # With the root turned to the left, its y axis is the world's -x axis.
    close(free_body.read(mdp.FootPos(sites="left_foot", frame="world")), [4.8, 5.6, 1.0])


def test_contact_terms_of_resting_and_lifted_boxes(boxes):
    at_rest = (0, 0, 0.1, *ROLL_90, 1, 0, 0.1, 1, 0, 0, 0)
    lifted = (0, 0, 0.1, *ROLL_90, 1, 0, 0.9, 1, 0, 0, 0)
    boxes.place(qpos=[at_rest, lifted])
    for _ in range(20):
        boxes.step()
    close(boxes.read(mdp.FootContact(sensor="touch")), [[1.0, 1.0], [1.0, 0.0]])
    close(boxes.read(mdp.FootAirTime(sensor="touch")), [[0.0, 0.0], [0.0, 0.4]])
    # A box at rest presses on the ground with its weight: 3 kg and 1 kg at 10 m/s^2.
    force = boxes.read(mdp.ContactForce(sensor="touch")).view(2, 2, 3)
    close(force[..., 2], [[-30.0, -10.0], [-30.0, 0.0]], atol=0.5)
    close(force[..., :2], 0.0, atol=0.5)
    # Box a is the root. It lies on its side: down is its -y.
    force = boxes.read(mdp.ContactForce(sensor="touch", frame="root")).view(2, 2, 3)
    close(force[..., 1], [[-30.0, -10.0], [-30.0, 0.0]], atol=0.5)
    force = boxes.read(mdp.FootContactForces(sensor="touch")).view(2, 2, 3)
    close(force[..., 2], [[-math.log(31.0), -math.log(11.0)], [-math.log(31.0), 0.0]], atol=0.02)
    close(force[..., :2], 0.0, atol=0.02)
    close(boxes.read(mdp.Contact(sensor="touch")), [[1.0, 1.0], [1.0, 0.0]])
    close(boxes.read(mdp.Contact(sensor="touch", threshold=20.0)), [[1.0, 0.0], [1.0, 0.0]])
    with pytest.raises(ValueError, match="tuoch.*touch"):
        boxes.read(mdp.Contact(sensor="tuoch"))


def test_contact_forces_keep_their_sign(make_bench):
    bench = make_bench(
        BLOCK_UNDER_CEILING, 1, {"touch": ContactSensor(geoms=("a",), against="ceiling")}
    )
    for _ in range(20):
        bench.step()
    force = bench.read(mdp.FootContactForces(sensor="touch"))
    close(force, [[0.0, 0.0, math.log(31.0)]], atol=0.02)
