"""What cameras see of randomized lenses, lights and colours: what they see in a world of the edited model."""

import pytest
import torch

from ksim_rl.physics import World
from ksim_rl.physics.ray_casting import BatchCamera, Picture
from tests.mdp.randomization.randomize_bench import RICH_FIELDS, Runners
from tests.mdp.randomization.test_randomize_physics import SEEN_EVENTS

E = 3
# Each with the camera that sees the difference.
LOOKS = {
    "camera_quat": "eye",
    "field_of_view": "eye",
    "intrinsic": "lens",
    "light_dir": "onlooker",
    "light_diffuse": "onlooker",
    "light_ambient": "onlooker",
    "material_color": "onlooker",
    "material_emission": "onlooker",
    "geom_color": "onlooker",
}


@pytest.fixture(scope="module")
def runners():
    return Runners(E, rich=True)


def picture(world: World, camera: str) -> torch.Tensor:
    world.refresh()
    renderer = BatchCamera(world, camera, Picture(width=24, height=18))
    renderer.render()
    return renderer.rgb_EHW3.int()


@pytest.mark.full
@pytest.mark.parametrize(("name", "camera"), LOOKS.items())
def test_each_world_is_seen_as_its_model_would_be(runners, name, camera):
    runners.restart()
    runners.place()
    undisturbed_HW3 = picture(runners.world, camera)[0]
    event = SEEN_EVENTS[name]
    runners.fire(event)
    seen_EHW3 = picture(runners.world, camera)
    assert (seen_EHW3[0] != seen_EHW3[1:]).any(), "the worlds do not differ"
    for row in range(E):
        assert (seen_EHW3[row] != undisturbed_HW3).any(), "it cannot be seen"
        edited = World(
            runners.c_model(row, event.per_world_fields), num_envs=1, per_world_fields=RICH_FIELDS
        )
        edited.qpos_EL.copy_(runners.world.qpos_EL[:1])
        assert (picture(edited, camera)[0] - seen_EHW3[row]).abs().max() <= 1
