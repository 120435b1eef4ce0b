import pytest
import torch

from ksim_rl.physics import SimCfg, World
from tests.physics.models import cartpole, quadruped, standing_quadrupeds


def observable(world: World) -> dict[str, torch.Tensor]:
    names = (
        "qpos",
        "qvel",
        "qacc",
        "sensordata",
        "actuator_force",
        "xpos",
        "cvel",
        "site_xpos",
        "time",
    )
    return {name: world.view(name).clone() for name in names}


def test_a_restored_world_continues_bit_for_bit():
    straight = standing_quadrupeds(per_world_fields=("body_mass",))
    straight.field("body_mass")[1] *= 1.5
    straight.set_const(("body_mass",))
    straight.gravity_EL[2, 2] = -5.0
    straight.xfrc_applied_EL[:, 1, 0] = 3.0
    for _ in range(5):
        straight.step(4)
    straight.refresh()
    saved = {name: tensor.clone() for name, tensor in straight.state_dict().items()}

    fresh = World(
        quadruped(), num_envs=4, sim=SimCfg(njmax=80, nconmax=40), per_world_fields=("body_mass",)
    )
    fresh.load_state_dict(saved)
    for name, tensor in observable(straight).items():
        assert torch.equal(observable(fresh)[name], tensor), f"{name} right after loading"
    for world in (straight, fresh):
        for _ in range(5):
            world.step(4)
        world.reset(torch.tensor([True, False, False, False]))
        world.step(4)
        world.refresh()
    for name, tensor in observable(straight).items():
        assert torch.equal(observable(fresh)[name], tensor), name


def test_state_is_a_copy():
    world = World(cartpole(), num_envs=2)
    saved = world.state_dict()
    world.qpos_EL.fill_(1.0)
    assert saved["qpos"].abs().max() == 0


def test_another_state_is_refused_before_anything_changes():
    world = World(cartpole(), num_envs=2)
    world.qpos_EL.fill_(0.25)
    saved = World(cartpole(), num_envs=3).state_dict()
    with pytest.raises(ValueError, match=r"'qpos' is .*\[3, 2\].*\[2, 2\]"):
        world.load_state_dict({**world.state_dict(), "qpos": saved["qpos"]})
    incomplete = world.state_dict()
    incomplete.pop("qvel")
    with pytest.raises(ValueError, match="has no 'qvel'"):
        world.load_state_dict(incomplete)
    assert (world.qpos_EL == 0.25).all()
