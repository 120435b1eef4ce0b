"""`Captured` and worlds in CUDA graphs."""

import dataclasses

import pytest
import torch

from ksim_rl.physics import Captured
from tests.gpu.no_syncs import no_syncs
from tests.physics.models import standing_quadrupeds


@pytest.mark.gpu
def test_captured_physics_and_torch_equal_eager_ones():
    eager, captured = (standing_quadrupeds(16, device="cuda") for _ in range(2))
    mask_E = torch.zeros(16, dtype=torch.bool, device="cuda")

    def body_of(world):
        reward_E = torch.zeros(16, device="cuda")

        def body() -> None:
            world.ctrl_EL.mul_(0.99)
            world.step(4)
            mask_E.copy_(world.qpos_EL[:, 2] < 0.2)
            world.reset(mask_E)
            world.refresh()
            reward_E.add_(world.qpos_EL[:, 2])

        return body, reward_E

    eager_body, eager_reward_E = body_of(eager)
    body, reward_E = body_of(captured)
    graph = Captured(body, device="cuda", warmup=2, require_graphs=True)
    for _ in range(8):
        eager_body()
        graph()
    assert graph.ready
    torch.testing.assert_close(captured.qpos_EL, eager.qpos_EL, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(reward_E, eager_reward_E, rtol=1e-3, atol=1e-3)


@pytest.mark.gpu
def test_what_runs_beside_the_rest_of_a_substep_changes_no_bit():
    both, alone = (standing_quadrupeds(512, device="cuda") for _ in range(2))
    assert both.one_kernel_rows_unavailable is None
    alone._substeps.stages = dataclasses.replace(alone._substeps.stages, side_stream=None)
    graphs = []
    for world in (both, alone):
        world.qvel_EL[:, 6:].add_(torch.linspace(-2.0, 2.0, 512, device="cuda")[:, None])

        def body(world=world) -> None:
            world.step(4, sensors="every")
            world.refresh()

        graphs.append(Captured(body, device="cuda", require_graphs=True))
    for _ in range(25):
        for graph in graphs:
            graph()
        for name in ("qpos", "qvel", "qacc", "sensordata", "xpos", "geom_xpos", "cvel", "overflow"):
            assert torch.equal(both.last_substep(name), alone.last_substep(name)), name
    assert all(graph.ready for graph in graphs) and both.last_substep("nacon").item() > 512


@pytest.mark.gpu
def test_a_replay_does_not_sync_and_counts_as_one_call():
    world = standing_quadrupeds(16, device="cuda")
    count = torch.zeros((), dtype=torch.int64, device="cuda")

    def body() -> None:
        world.step(2)
        world.refresh()
        count.add_(1)

    no_row_E = torch.zeros(16, dtype=torch.bool, device="cuda")
    graph = Captured(body, device="cuda", require_graphs=True)
    for _ in range(4):
        graph()
        world.step(2)
        world.refresh()
        world.reset(no_row_E)
    with no_syncs():
        graph()
        world.step(2)
        world.refresh()
        world.reset(no_row_E)
    assert count.item() == 5


@pytest.mark.gpu
def test_an_uncapturable_body_says_so():
    total = torch.zeros((), device="cuda")
    graph = Captured(lambda: total.add_(total.item()), device="cuda", warmup=1)
    graph()
    with pytest.raises(RuntimeError, match="cannot be captured"):
        graph()


@pytest.mark.gpu
def test_a_world_joins_a_capture_that_torch_began():
    world, eager = (standing_quadrupeds(16, device="cuda") for _ in range(2))
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        world.step(4)
        world.refresh()
    graph.replay()
    eager.step(4)
    eager.refresh()
    torch.testing.assert_close(world.qpos_EL, eager.qpos_EL, rtol=1e-3, atol=1e-3)
