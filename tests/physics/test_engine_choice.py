"""Which engine simulates where the settings leave it open, and what a world says about it."""

import mujoco
import pytest
import torch

from ksim_rl.physics import SimCfg, World
from ksim_rl.physics.c_engine.c_world import CWorld
from ksim_rl.physics.engine_choice import LEAST_DOFS, LEAST_WORLDS, choose_engine
from ksim_rl.physics.warp_world import WarpWorld
from tests.physics.models import cartpole

BALL = '<body pos="{x} 0 1"><freejoint/><geom size="0.1" mass="1"/></body>'
CPU = torch.device("cpu")


def balls(count: int) -> mujoco.MjModel:
    bodies = "".join(BALL.format(x=number) for number in range(count))
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")


LARGE = balls(3)


def test_the_rule_is_of_sizes_alone():
    assert LARGE.nv >= LEAST_DOFS > cartpole().nv
    for mj_model, num_envs, expected in (
        (LARGE, LEAST_WORLDS, "c"),
        (LARGE, LEAST_WORLDS - 1, "warp"),
        (cartpole(), 100 * LEAST_WORLDS, "warp"),
    ):
        engine, why = choose_engine(SimCfg(), mj_model, num_envs=num_envs, device=CPU)
        assert engine == expected
        assert why.endswith(f"and here are {mj_model.nv} in {num_envs}")


@pytest.mark.parametrize(
    ("sim", "device", "warp_alone", "said"),
    [
        (SimCfg(one_kernel_dynamics=True), "cpu", (), "one_kernel_dynamics=true"),
        (SimCfg(one_kernel_dynamics=False), "cpu", (), "one_kernel_dynamics=false"),
        (SimCfg(require_graphs=True), "cpu", (), "require_graphs=true"),
        (SimCfg(engine="warp"), "cpu", (), "task.sim.engine=warp"),
        (SimCfg(), "cuda", (), "runs on the CPU alone"),
        (SimCfg(), "cpu", ("cameras of all worlds",), "has no cameras of all worlds"),
    ],
)
def test_what_c_cannot_do_makes_it_warp_and_the_words_name_it(sim, device, warp_alone, said):
    how = {"num_envs": LEAST_WORLDS, "device": torch.device(device), "warp_alone": warp_alone}
    engine, why = choose_engine(sim, LARGE, **how)
    assert engine == "warp"
    assert said in why


def test_a_world_names_the_engine_that_was_chosen():
    world = World(LARGE, num_envs=LEAST_WORLDS)
    assert isinstance(world, CWorld)
    assert world.sim.engine == "c"
    assert world.explained()[-1] == f"engine c: {world.engine_because}"
    few = World(cartpole(), num_envs=2)
    assert isinstance(few, WarpWorld)
    assert few.sim.engine == "warp"
    asked = World(LARGE, num_envs=LEAST_WORLDS, warp_alone=("cameras of all worlds",))
    assert asked.explained()[-1] == "engine warp: MuJoCo's C engine has no cameras of all worlds"
