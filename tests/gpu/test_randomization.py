"""Randomization in a CUDA graph."""

import pytest
import torch

from ksim_rl.physics import Captured
from tests.envs.mdp.randomize_bench import INERTIAL, Runners
from tests.envs.mdp.test_randomize_physics import EVENTS

E = 64


@pytest.mark.gpu
@pytest.mark.parametrize("name", EVENTS)
def test_replayed_events_write_what_the_cpu_writes(name):
    event = EVENTS[name]
    on_cpu, on_gpu = Runners(E), Runners(E, device="cuda")
    mask_E = torch.arange(E) % 3 == 0
    mask_on_gpu_E = mask_E.cuda()
    graph = Captured(lambda: on_gpu.fire(event, mask_on_gpu_E), device="cuda", require_graphs=True)
    for count in range(4):
        for runners, fire in ((on_cpu, lambda: on_cpu.fire(event, mask_E)), (on_gpu, graph)):
            runners.view.reset_count_E.fill_(count)
            fire()
    assert graph.ready
    constants = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0", "geom_rbound")
    for field in (*event.per_world_fields, *constants):
        expected, actual = on_cpu.world.field(field), on_gpu.world.field(field).cpu()
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.gpu
def test_masked_constants_equal_those_of_all_rows():
    runners = Runners(E, device="cuda")
    runners.fire(EVENTS["pseudo_inertia"])
    names = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")
    masked = {name: runners.world.field(name).clone() for name in names}
    runners.world.set_const(INERTIAL)
    for name, values in masked.items():
        torch.testing.assert_close(values, runners.world.field(name), rtol=1e-5, atol=1e-6)
