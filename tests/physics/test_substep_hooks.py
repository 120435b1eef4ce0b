"""What runs between two substeps, and what it must not change."""

import pytest
import torch

from ksim_rl.device.capture import live_launches
from ksim_rl.physics import SimCfg
from ksim_rl.physics.views import arrays
from ksim_rl.testing import count_syncs
from tests.physics.models import sensor, standing_quadrupeds

STATE = ("qpos", "qvel", "qacc", "time", "sensordata", "actuator_force")


def test_hooks_that_do_nothing_change_nothing():
    plain, hooked = standing_quadrupeds(), standing_quadrupeds()
    called = []
    for _ in range(2):
        plain.step(4)
        hooked.step(
            4, before=[lambda: called.append("before")], after=[lambda: called.append("after")]
        )
    assert called == ["before", "after"] * 8
    for name in STATE:
        assert torch.equal(plain.view(name), hooked.view(name)), name


def test_substeps_that_nobody_reads_end_as_those_that_hooks_read():
    sim = SimCfg(njmax=80, nconmax=40, one_kernel_dynamics=True)
    plain, hooked, by_hand = (standing_quadrupeds(sim=sim) for _ in range(3))
    assert plain.one_kernel_integration_unavailable is None
    poses, seen = [], []
    for _ in range(2):
        plain.step(4)
        hooked.step(4, after=[lambda: poses.append(hooked.last_substep("xmat").clone())])
        for _ in range(4):
            by_hand.step(1)
            seen.append(by_hand.last_substep("xmat").clone())
    assert torch.equal(torch.stack(poses), torch.stack(seen))
    own, theirs = (arrays(world.warp_data_E) for world in (plain, hooked))
    for name, array in own.items():
        assert array.numpy().tobytes() == theirs[name].numpy().tobytes(), name
    assert plain.overflow_report() == hooked.overflow_report()


def test_each_substep_takes_the_controls_that_the_hook_before_it_wrote():
    by_hand, hooked = standing_quadrupeds(), standing_quadrupeds()
    ramp_KL = torch.linspace(-0.3, 0.3, 4)[:, None] + by_hand.ctrl_EL[0]
    for _ in range(2):  # recorded, then replayed
        controls = iter(ramp_KL)
        times = []
        hooked.step(
            4,
            before=[
                lambda controls=controls: hooked.ctrl_EL.copy_(
                    next(controls).expand_as(hooked.ctrl_EL)
                )
            ],
            after=[lambda times=times: times.append(hooked.time_E.clone())],
        )
        for ctrl_L in ramp_KL:
            by_hand.ctrl_EL.copy_(ctrl_L.expand_as(by_hand.ctrl_EL))
            by_hand.step(1)
    assert torch.equal(hooked.qpos_EL, by_hand.qpos_EL)
    assert torch.equal(hooked.qvel_EL, by_hand.qvel_EL)
    assert (torch.stack(times).diff(dim=0) > 0).all()


def test_hooks_inside_an_outer_warm_up_are_the_same():
    graphs, live = standing_quadrupeds(), standing_quadrupeds()
    for world in (graphs, live):
        hook = [lambda world=world: world.ctrl_EL.mul_(0.9)]
        if world is live:
            with live_launches():
                world.step(3, before=hook)
        else:
            world.step(3, before=hook)
    assert torch.equal(graphs.qpos_EL, live.qpos_EL)


def test_sensors_are_read_on_every_substep_only_if_asked():
    world = standing_quadrupeds()
    columns = sensor(world, "acceleration")
    readings = {}
    for which in ("last", "every"):
        seen = readings[which] = []
        world.step(
            3,
            after=[lambda seen=seen: seen.append(world.sensordata_EL[:, columns].clone())],
            sensors=which,
        )
    assert torch.equal(readings["last"][0], readings["last"][1])
    assert not torch.equal(readings["last"][1], readings["last"][2])
    assert not torch.equal(readings["every"][0], readings["every"][1])


@pytest.mark.parametrize("ours", (False, True))
def test_of_contacts_alone_are_those_that_all_on_every_substep_have(ours):
    readings, sim = {}, SimCfg(njmax=80, nconmax=40, one_kernel_dynamics=ours)
    for which in ("contacts", "every"):
        world, seen = standing_quadrupeds(sim=sim), readings.setdefault(which, [])
        world.step(
            3,
            after=[lambda seen=seen, world=world: seen.append(world.sensordata_EL.clone())],
            sensors=which,
        )
    touches, accelerates = (sensor(world, name) for name in ("rear_left_contact", "acceleration"))
    for own, true in zip(readings["contacts"], readings["every"], strict=True):
        assert torch.equal(own[:, touches], true[:, touches]) and own[:, touches].any()
    assert not readings["contacts"][1][:, accelerates].any()
    assert torch.equal(
        readings["contacts"][2][:, accelerates], readings["every"][2][:, accelerates]
    )


def test_every_without_hooks_reaches_the_same_state():
    last, every = standing_quadrupeds(), standing_quadrupeds()
    last.step(3)
    every.step(3, sensors="every")
    for world in (last, every):
        world.refresh()
    for name in STATE:
        assert torch.equal(last.view(name), every.view(name)), name


def test_hooked_steps_do_not_sync():
    world = standing_quadrupeds()
    hook = [lambda: world.ctrl_EL.mul_(0.99)]
    world.step(2, before=hook)
    with count_syncs() as syncs:
        world.step(2, before=hook, after=hook)
    assert syncs.total == 0, syncs.report()


def test_another_choice_of_sensors_is_refused():
    with pytest.raises(ValueError, match="sensors='all'"):
        standing_quadrupeds(1).step(1, sensors="all")
