"""A world's own graphs: what is recorded, what is replayed, and what is launched live."""

import pytest
import torch
import warp as wp

from ksim_rl.device.capture import WarpGraphs, live_launches
from tests.physics.models import standing_quadrupeds

CPU = torch.device("cpu")


@wp.kernel(module="unique", enable_backward=False)
def count_one(values: wp.array[float]):
    values[wp.tid()] += 1.0


class Counter:
    """Launches that count in Warp how often they ran, and in Python how often they were issued."""

    def __init__(self) -> None:
        self.values = wp.zeros(1, dtype=float, device="cpu")
        self.issued = 0

    def __call__(self) -> None:
        self.issued += 1
        wp.launch(count_one, dim=1, inputs=[self.values], device="cpu")

    @property
    def ran(self) -> float:
        return self.values.numpy()[0]


def test_each_key_is_recorded_once_and_replayed():
    graphs, one, other = WarpGraphs(CPU), Counter(), Counter()
    for _ in range(3):
        graphs.run("one", one)
    graphs.run("other", other)
    assert (one.issued, one.ran, other.issued, other.ran) == (1, 3.0, 1, 1.0)
    graphs.clear()
    graphs.run("one", one)
    assert (one.issued, one.ran) == (2, 4.0)


def test_a_warm_up_replays_what_exists_and_records_nothing():
    graphs, known, new = WarpGraphs(CPU), Counter(), Counter()
    graphs.run("known", known)
    with live_launches(warming_up=True):
        for _ in range(2):
            graphs.run("known", known)
            graphs.run("new", new)
    assert (known.issued, known.ran) == (1, 3.0)
    assert (new.issued, new.ran) == (2, 2.0)
    graphs.run("new", new)
    assert (new.issued, new.ran) == (3, 3.0), "recorded only now"


def test_what_is_live_is_issued_each_time():
    graphs, counter = WarpGraphs(CPU), Counter()
    graphs.run("key", counter)
    for _ in range(2):
        graphs.run("key", counter, live=True)
    graphs.run("key", counter)
    assert (counter.issued, counter.ran) == (3, 4.0)


def test_a_callback_that_is_set_later_is_called_in_each_substep():
    world = standing_quadrupeds()
    world.step(2)
    calls = []
    world.warp_model.callback.control = lambda m, d: calls.append(1)
    for _ in range(3):
        world.step(2)
    assert len(calls) == 6
    world.warp_model.callback.control = None
    world.step(2)
    assert len(calls) == 6


def test_without_a_callback_of_a_program_substeps_are_replayed(monkeypatch):
    world = standing_quadrupeds()
    world.step(2)
    monkeypatch.setattr(world, "_launch_substeps", lambda *_: pytest.fail("issued once more"))
    world.step(2)


@pytest.mark.parametrize("capturing", [True, False])
def test_a_capture_launches_live_what_has_a_graph(capturing):
    graphs, known = WarpGraphs(CPU), Counter()
    graphs.run("known", known)
    with live_launches(capturing=capturing):
        graphs.run("known", known)
    assert (known.issued, known.ran) == (2, 2.0)


def test_a_world_has_the_graphs_of_resets_before_any_warm_up(monkeypatch):
    world = standing_quadrupeds()
    issued = []
    for name in ("_launch_reset", "_launch_substeps"):
        monkeypatch.setattr(world, name, lambda *_, name=name: issued.append(name))
    monkeypatch.setattr(world._substeps, "refresh", lambda: issued.append("refresh"))

    def warm_up() -> None:
        with live_launches(warming_up=True):
            world.step(3)
            world.reset(torch.zeros(world.num_envs, dtype=torch.bool))
            world.refresh()

    warm_up()
    assert issued == ["_launch_substeps"], "the warm-up of an outer capture loads its kernels"
    world.view("subtree_linvel")
    issued.clear()
    warm_up()
    assert issued == ["_launch_substeps"], "another refresh makes other graphs"
