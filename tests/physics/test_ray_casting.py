"""Cameras of worlds whose model fields differ."""

import pytest
import torch

from ksim_rl.physics import World, load_model
from ksim_rl.physics.ray_casting import BatchCamera, Picture

CAMERA_HEIGHT = 2.0
FIELDS = """
<mujoco>
  <asset>
    <hfield name="low" nrow="2" ncol="2" size="1 1 0.4 0.1" elevation="1 1 1 0"/>
    <hfield name="high" nrow="2" ncol="2" size="1 1 0.9 0.1" elevation="1 1 1 0"/>
  </asset>
  <worldbody>
    <geom name="ground" type="hfield" hfield="low"/>
    <geom name="pole" type="sphere" size="0.1" pos="3 0 0"/>
    <camera name="down" pos="-0.5 -0.5 2" fovy="20"/>
  </worldbody>
</mujoco>
"""
"""Each field is flat at its full height where the camera looks; the model's own geom uses the low one only."""


def test_each_world_shows_the_height_field_that_it_collides_with():
    world = World(load_model(FIELDS), num_envs=2, per_world_fields=("geom_dataid",))
    camera = BatchCamera(world, "down", Picture(width=3, height=3, rgb=False, depth=True))
    world.field("geom_dataid")[:, 0] = torch.tensor([0, 1], dtype=torch.int32)
    camera.render()
    middle_E = camera.depth_EHW[:, 1, 1]
    expected_E = torch.tensor([CAMERA_HEIGHT - 0.4, CAMERA_HEIGHT - 0.9])
    torch.testing.assert_close(middle_E, expected_E, atol=1e-3, rtol=0)


def test_each_world_has_its_own_sizes_and_fields_of_view():
    model = load_model(
        """<mujoco><worldbody>
        <geom name="disc" type="cylinder" size="0.2 0.01"/>
        <camera name="down" pos="0 0 1" fovy="90"/></worldbody></mujoco>"""
    )
    world = World(model, num_envs=3, per_world_fields=("geom_size", "cam_fovy"))
    world.field("geom_size")[1, 0, 0] = 0.4
    world.field("cam_fovy")[2] = 53.13  # half of the height of the picture at 1 m
    camera = BatchCamera(world, "down", Picture(width=64, height=64, rgb=False, segmentation=True))
    camera.render()
    seen_E = (camera.segmentation_EHW2[..., 0] == 0).float().mean((1, 2))
    # The picture is 2 m wide at 1 m (1 m in world 2), the disc is pi r^2.
    expected_E = torch.pi * torch.tensor([0.2, 0.4, 0.2]) ** 2 / torch.tensor([4.0, 4.0, 1.0])
    torch.testing.assert_close(seen_E, expected_E, atol=0.0, rtol=0.05)


def test_a_camera_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="Camera 'up' not found"):
        BatchCamera(World(load_model(FIELDS), num_envs=1), "up", Picture(width=2, height=2))
