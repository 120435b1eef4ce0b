"""Randomization in a CUDA graph."""

import mujoco_warp as mjw
import numpy as np
import pytest
import torch

from ksim_rl.physics import Captured
from tests.gpu.no_syncs import no_syncs
from tests.mdp.randomization.randomize_bench import Runners
from tests.mdp.randomization.test_randomize_physics import EVENTS, SUBSTEPS

E = 64
CONSTANTS = ("body_subtreemass", "body_invweight0", "dof_invweight0", "actuator_acc0")

pytestmark = pytest.mark.gpu


@pytest.fixture(scope="module")
def replayed():
    return Runners(E, device="cuda")


@pytest.fixture(scope="module")
def eager():
    return Runners(E, device="cuda")


@pytest.mark.parametrize("name", EVENTS)
def test_replayed_events_draw_as_eager_ones_and_the_worlds_move_as_in_the_c_engine(
    replayed, eager, name
):
    event, mask_E = EVENTS[name], torch.arange(E, device="cuda") % 3 == 0
    for runners in (replayed, eager):
        runners.restart()
    graph = Captured(lambda: replayed.fire(event, mask_E), device="cuda", require_graphs=True)
    for count in range(4):
        for runners in (replayed, eager):
            runners.view.reset_count_E.fill_(count)
        with no_syncs(on=graph.ready):
            graph()
        eager.fire(event, mask_E)
    assert graph.ready
    fields = {name: replayed.world.field(name) for name in event.per_world_fields}
    for name, values in fields.items():
        torch.testing.assert_close(values, eager.world.field(name), rtol=1e-5, atol=1e-6)
        assert torch.equal(values[~mask_E], replayed.own[f"field/{name}"][~mask_E]), (
            "rows outside of the mask"
        )
    assert any(not torch.equal(values[0], values[3]) for values in fields.values()), (
        "two rows that draw"
    )
    ends = replayed.run(SUBSTEPS)
    undisturbed = replayed.c_run(replayed.world.mj_model, SUBSTEPS)
    for row in (0, 1, E - 1):
        c_model = replayed.c_model(row, event.per_world_fields)
        for constant in CONSTANTS:
            actual = replayed.world.field(constant)[row].cpu().numpy()
            np.testing.assert_allclose(
                actual, getattr(c_model, constant), rtol=1e-4, atol=1e-5, err_msg=constant
            )
        expected = replayed.c_run(c_model, SUBSTEPS)
        effect = np.abs(expected - undisturbed).max()
        assert bool(mask_E[row]) == (effect > 1e-3), (
            "the field makes a difference where it was drawn"
        )
        assert np.abs(ends[row] - expected).max() < 0.005 * effect + 1e-4, row


def test_masked_constants_equal_those_of_all_rows(replayed):
    replayed.restart()
    replayed.fire(EVENTS["pseudo_inertia"])
    masked = {name: replayed.world.field(name).clone() for name in CONSTANTS}
    mjw.set_const(replayed.world.warp_model, replayed.world.warp_data_E)
    for name, values in masked.items():
        torch.testing.assert_close(values, replayed.world.field(name), rtol=1e-5, atol=1e-6)
