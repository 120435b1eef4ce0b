import mujoco
import mujoco_warp as mjw
import pytest
import torch

from ksim_rl.physics import SimCfg, World
from ksim_rl.physics.overflow import METRIC_BITS
from tests.physics.models import quadruped, standing_quadrupeds
from tests.physics.overflowing_models import SCENES, bullet, can_on_fine_field, felt_crowd, pile, sensed_box


def fallen(sim: SimCfg) -> World:
    world = World(quadruped(), num_envs=4, sim=sim)
    world.qpos_EL[:, 2] = 0.3
    return world


def test_enough_room_reports_nothing():
    world = standing_quadrupeds()
    report = world.overflow_report()
    assert report.ok
    assert 8 + 4 * 4 <= report.nefc <= report.njmax
    assert 4 * 2 <= report.ncon <= report.naconmax
    assert 0.0 < report.metrics["nefc_share"] <= 1.0


def test_too_few_rows_names_the_need():
    world = fallen(SimCfg(njmax=10, nconmax=40))
    world.step(4)
    world.reset(torch.ones(4, dtype=torch.bool))
    report = world.overflow_report()
    assert report.worlds["NEFC"] == 4
    assert (report.njmax, report.nconmax) == (10, 40)
    assert report.nefc > 10
    assert f"set sim.njmax >= {report.nefc}" in report.messages[0]
    assert "has 10" in report.messages[0]
    assert world.overflow_report().nefc == 0, "a report starts a new period"


def test_too_few_contacts_names_the_need():
    world = fallen(SimCfg(njmax=80, nconmax=1))
    world.step(1)
    report = world.overflow_report()
    assert not report.ok
    needed = -(-report.ncon // 4)
    assert needed > 1
    assert any(f"set sim.nconmax >= {needed} (now 1 per world" in message for message in report.messages)
    roomy = fallen(SimCfg(njmax=80, nconmax=needed))
    roomy.step(1)
    assert roomy.overflow_report().ok


def test_an_overflow_between_two_reports_is_seen_once():
    world = fallen(SimCfg(njmax=10, nconmax=40))
    world.step(1)
    assert not world.overflow_report(clear=False).ok
    assert not world.overflow_report().ok
    world.reset(torch.ones(4, dtype=torch.bool))
    world.qpos_EL[:, 2] = 5.0
    world.step(1)
    assert world.overflow_report().worlds["NEFC"] == 0


def test_solver_limits_are_metrics_not_messages():
    world = fallen(SimCfg(njmax=80, nconmax=40, iterations=1, ls_iterations=1))
    world.step(4)
    report = world.overflow_report()
    assert report.ok
    assert report.metrics["iterations_worlds"] > 0.0


def piled(mj_model: mujoco.MjModel, sim: SimCfg) -> World:
    """Three worlds after their first substep, each from another pose."""
    world = World(mj_model, num_envs=3, sim=sim)
    generator = torch.Generator().manual_seed(3)
    world.qpos_EL.add_(0.03 * torch.rand(world.qpos_EL.shape, generator=generator))
    world.step(1)
    return world


@pytest.mark.parametrize("ours", [True, False])
@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: "-".join(map(str, scene)))
def test_each_overflow_is_told_in_scenes_of_every_kind(scene, ours):
    mj_model = pile(*scene)
    roomy = piled(mj_model, SimCfg(njmax=400, nconmax=200, one_kernel_dynamics=ours)).overflow_report()
    assert roomy.ok and roomy.nefc > 16 and roomy.ncon > 12
    places = -(-roomy.ncon // 3)
    enough = piled(mj_model, SimCfg(njmax=roomy.nefc, nconmax=places, one_kernel_dynamics=ours))
    assert enough.overflow_report().ok
    for njmax in (roomy.nefc - 1, roomy.nefc // 3):
        report = piled(mj_model, SimCfg(njmax=njmax, nconmax=200, one_kernel_dynamics=ours)).overflow_report()
        assert report.worlds["NEFC"], (njmax, report)
        assert report.nefc == roomy.nefc, "the need is that of the world with the most rows"
    # Contacts that found no place have no rows, so that here those may suffice.
    for njmax, nconmax in ((400, places - 1), (400, 1), (12, 1)):
        report = piled(
            mj_model, SimCfg(njmax=njmax, nconmax=nconmax, one_kernel_dynamics=ours)
        ).overflow_report()
        assert report.worlds["BROADPHASE"] or report.worlds["NARROWPHASE"], (njmax, nconmax, report)


@pytest.mark.parametrize("ours", [True, False])
def test_more_prisms_of_a_height_field_than_there_is_room_for_are_told(ours):
    world = World(can_on_fine_field(), num_envs=2, sim=SimCfg(one_kernel_dynamics=ours))
    world.step(1)
    report = world.overflow_report()
    assert report.worlds["HFIELD"] == 2
    assert "too many height-field cells" in report.messages[0]


@pytest.mark.parametrize("sim", [{"one_kernel_dynamics": True}, {}, {"one_kernel_solver": False}])
def test_a_sensor_matches_as_many_contacts_as_in_c(sim):
    world = World(sensed_box("none"), num_envs=2, sim=SimCfg(**sim))
    world.step(1)
    report = world.overflow_report()
    assert report.worlds["CONTACT_MATCH"] == 0, "MuJoCo Warp has room for two of four"
    mj_data = mujoco.MjData(world.mj_model)
    mujoco.mj_step(world.mj_model, mj_data)
    found = torch.from_numpy(mj_data.sensordata).float().expand(2, -1)
    torch.testing.assert_close(world.sensordata_EL, found, atol=1e-6, rtol=0.0)


@pytest.mark.parametrize("ours", [True, False])
def test_more_geoms_than_a_tactile_sensor_keeps_are_told(ours):
    world = World(felt_crowd(), num_envs=2, sim=SimCfg(one_kernel_dynamics=ours))
    world.step(1)
    report = world.overflow_report()
    assert report.worlds["TACTILE"] == 2
    assert "tactile" in report.messages[0]


@pytest.mark.parametrize("bit", [bit for bit in mjw.OverflowType if bit and bit & (bit - 1) == 0], ids=str)
@pytest.mark.parametrize("sim", [{"one_kernel_dynamics": True}, {}, {"one_kernel_solver": False}])
def test_each_bit_of_a_substep_is_told_even_if_the_world_resets_after_it(sim, bit):
    world = World(quadruped(), num_envs=4, sim=SimCfg(njmax=80, nconmax=40, **sim))
    world.qpos_EL[:, 2] = 5.0
    # It comes before the solver, as the collisions do that set most of them.
    world.warp_model.callback.control = lambda m, d: d.overflow.fill_(int(bit))
    world.step(1)
    world.warp_model.callback.control = None
    world.reset(torch.ones(4, dtype=torch.bool))
    world.step(2)
    report = world.overflow_report()
    assert report.worlds[bit.name] == 4
    assert report.ok == (bit.name in METRIC_BITS)
    assert world.overflow_report().ok


def test_rows_that_did_not_fit_half_way_through_a_substep_are_told():
    world = World(bullet(), num_envs=2, sim=SimCfg(njmax=1, nconmax=4))
    world.qvel_EL[:, 2] = -20.0
    world.step(1)
    assert int(world.last_substep("nefc").max()) == 0, "at the end there are no rows"
    report = world.overflow_report()
    assert report.worlds["NEFC"] == 2 and report.nefc == 4


def test_a_world_that_goes_on_is_told_of_once():
    world = fallen(SimCfg(njmax=10, nconmax=40))
    world.step(4)
    assert world.overflow_report().worlds["NEFC"] == 4
    world.qpos_EL[:, 2] = 5.0
    world.step(4)
    assert world.overflow_report().ok, "nothing was lost since"
