from collections.abc import Sequence
from typing import Any

import mujoco
import mujoco_warp as mjw
import pytest
import torch

from ksim_rl.physics import OverflowReport, SimCfg, World, load_model
from ksim_rl.physics.overflow import METRIC_BITS
from ksim_rl.physics.warp_world import WarpWorld
from tests.physics.models import quadruped, standing_quadrupeds
from tests.physics.overflowing_models import (
    SCENES,
    bullet,
    can_on_fine_field,
    felt_crowd,
    pile,
    sensed_box,
)

# Their ground or their things, and their cones, are in the others, too.
LONG_SCENES = SCENES[1:8]


def scenes():
    found = []
    for scene in SCENES:
        marks = [pytest.mark.full] if scene in LONG_SCENES else []
        found.append(pytest.param(scene, marks=marks))
    return found


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


@pytest.mark.parametrize("solver", ("Newton", "CG"))
def test_rows_of_ties_without_room_are_not_read_from_the_next_world(solver: str):
    mj_model = load_model(
        f"""<mujoco>
          <option solver="{solver}" jacobian="dense"/>
          <worldbody><body name="ball"><freejoint/><geom size="0.1"/></body></worldbody>
          <equality><weld body1="ball" relpose="0.1 0 0 1 0 0 0"/></equality>
        </mujoco>"""
    )
    world = World(mj_model, num_envs=2, sim=SimCfg(njmax=2, nconmax=2, one_kernel_solver=False))
    world.qvel_EL[1] = torch.nan
    world.step(1)
    assert world.overflow_report().worlds["NEFC"] == 2
    # Two rows of the tie pull along x and y, and gravity along z.
    assert world.view("qacc")[0, 2].item() == pytest.approx(-9.81, rel=1e-4)
    assert world.view("qacc")[0, 0].abs() > 1.0


def test_discrete_steps_have_room_for_whole_tiles_of_rows():
    """MuJoCo Warp went through rows beyond njmax there, up to the end of a tile: an illegal access on a GPU."""
    world = fallen(SimCfg(njmax=10, nconmax=40, integrator="discrete"))
    assert isinstance(world, WarpWorld)
    assert world.njmax == world.warp_data_E.efc.D.shape[1] == 16
    world.step(4)
    report = world.overflow_report()
    assert report.nefc > 16 and report.worlds["NEFC"] == 4


def test_too_few_contacts_names_the_need():
    world = fallen(SimCfg(njmax=80, nconmax=1))
    world.step(1)
    report = world.overflow_report()
    assert not report.ok
    needed = -(-report.ncon // 4)
    assert needed > 1
    assert any(
        f"set sim.nconmax >= {needed} (now 1 per world" in message for message in report.messages
    )
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


def piled(
    mj_model: mujoco.MjModel, sim: SimCfg, *, device: str, num_envs: int, repeats: bool
) -> OverflowReport:
    """Report a substep from given poses, each world's its own, that a graph replays where there are any."""
    world = World(mj_model, num_envs=num_envs, device=device, sim=sim)
    generator = torch.Generator().manual_seed(3)
    moved_EL = 0.03 * torch.rand(world.qpos_EL.shape, generator=generator)
    pose_EL = world.qpos_EL + moved_EL.to(world.device)
    reports = []
    for _ in range(3):
        world.reset(torch.ones(num_envs, dtype=torch.bool, device=world.device))
        world.qpos_EL.copy_(pose_EL)
        world.step(1)
        reports.append(world.overflow_report())
    first, *later = reports
    # Which contacts find a place in a pool that is full may differ.
    if repeats and not first.worlds["BROADPHASE"] and not first.worlds["NARROWPHASE"]:
        for report in later:
            assert (report.worlds["NEFC"], report.nefc) == (first.worlds["NEFC"], first.nefc)
    return reports[-1]


def check_overflows(
    scene: Sequence[Any], *, ours: bool, device: str = "cpu", num_envs: int = 3
) -> None:
    """Make the room of a scene too small in every way, and check that each overflow is reported, and no other."""
    mj_model = pile(*scene)
    # On a GPU the threads of MuJoCo Warp's rows race for the Jacobian, and those that lose count no rows.
    counts_all = ours or device == "cpu"

    def report_with(njmax: int, nconmax: int) -> OverflowReport:
        sim = SimCfg(njmax=njmax, nconmax=nconmax, one_kernel_dynamics=ours)
        return piled(mj_model, sim, device=device, num_envs=num_envs, repeats=counts_all)

    roomy = report_with(400, 200)
    assert roomy.ok and roomy.nefc > 16 and roomy.ncon > 4 * num_envs
    places = -(-roomy.ncon // num_envs)
    assert report_with(roomy.nefc, places).ok
    for njmax in (roomy.nefc - 1, roomy.nefc // 3):
        report = report_with(njmax, 200)
        assert report.worlds["NEFC"], (njmax, report)
        if counts_all:
            assert report.nefc == roomy.nefc, "the need is the largest of any world"
    # Contacts that found no place have no rows, so that here those may suffice.
    for njmax, nconmax in ((400, places - 1), (400, 1), (12, 1)):
        report = report_with(njmax, nconmax)
        assert report.worlds["BROADPHASE"] or report.worlds["NARROWPHASE"], (njmax, nconmax, report)


@pytest.mark.parametrize("ours", [True, False])
@pytest.mark.parametrize("scene", scenes(), ids=lambda scene: "-".join(map(str, scene)))
def test_each_overflow_is_told_in_scenes_of_every_kind(scene, ours):
    check_overflows(scene, ours=ours)


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


@pytest.mark.parametrize(
    "bit", [bit for bit in mjw.OverflowType if bit and bit & (bit - 1) == 0], ids=str
)
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


@pytest.mark.parametrize("flags", ("", 'spring="disable" damper="disable" actuation="disable"'))
def test_rows_that_did_not_fit_half_way_through_a_substep_are_told(flags: str):
    world = World(bullet(flags), num_envs=2, sim=SimCfg(njmax=1, nconmax=4))
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
