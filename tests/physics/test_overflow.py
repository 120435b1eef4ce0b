import torch

from ksim_rl.physics import SimCfg, World
from tests.physics.models import quadruped, standing_quadrupeds


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
