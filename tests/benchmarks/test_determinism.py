"""The determinism benchmark finds equal runs equal, and any bit that is planted."""

import itertools
import math

import pytest
import torch

from benchmarks import command_line, determinism, report
from benchmarks.faults import children

TINY = (*children.SMALLEST, *determinism.QUIET)


def spoil_at(iteration, *, name):
    def change(trainer):
        if trainer.iteration == iteration:
            view = trainer.collector.env.base_env.world.view(name)
            view[-1, -1] = torch.nextafter(view[-1, -1], torch.tensor(torch.inf))

    return change


def test_equal_runs_have_equal_hashes_and_a_planted_bit_is_found_and_named():
    cfg = command_line.compose(TINY)
    one, same = (determinism.train(cfg, iterations=2) for _ in range(2))
    assert determinism.differing([one, same]) == {1: [], 2: []}
    assert one.digest == same.digest and determinism.explain({1: [], 2: []}) == []
    other = determinism.train(cfg, iterations=2, change=spoil_at(2, name="qacc_warmstart"))
    found = determinism.differing([one, same, other])
    assert found[1] == []
    assert sorted(found[2]) == ["/env/base_env.world.qacc_warmstart", "/world/qacc_warmstart"]
    assert other.digest != one.digest
    assert determinism.explain(found) == [
        f"after iteration 2, 2 differ: {', '.join(found[2])}",
    ]


def test_everything_is_looked_at():
    look = determinism.train(command_line.compose(TINY), iterations=1).looks[1]
    prefixes = ("actor", "critic", "optimizer", "sampler")
    for prefix in (
        *(f"/update/{name}" for name in prefixes),
        "/rollout",
        "/dataset",
        "/metrics",
        "/random",
    ):
        assert any(path.startswith(prefix) for path in look), prefix
    for path in (
        "/world/qpos",
        "/world/efc.force",
        "/world/contact.dist",
        "/env/base_env.world.qpos",
    ):
        assert any(known.startswith(path) for known in look), path
    assert not any("seconds" in path for path in look)


def test_each_run_is_composed_and_the_clutter_has_cubes_of_one_size_that_are_apart():
    cfgs = {
        name: command_line.compose([*words, "device=cpu"])
        for name, words in determinism.TASKS.items()
    }
    scene = cfgs["arm_clutter"].task.scene
    assert len(scene.objects) == 7 and {box.size for box in scene.objects.values()} == {
        (0.06, 0.06, 0.06)
    }
    diagonal, places = 0.06 * math.sqrt(2.0), [place.pos[:2] for place in scene.placements.values()]
    assert all(math.dist(*pair) > diagonal for pair in itertools.combinations(places, 2))


def test_the_switch_is_on_while_half_of_the_runs_are_timed_and_off_afterwards(monkeypatch):
    seen = []

    def timed(trainer):
        seen.append(torch.are_deterministic_algorithms_enabled())
        return 5.0 if seen[-1] else 4.0

    monkeypatch.setattr(determinism, "iteration_ms", timed)
    assert determinism.on_over_off(command_line.compose(TINY)) == pytest.approx(0.8)
    assert seen == [False, True, True, False] and not torch.are_deterministic_algorithms_enabled()


def test_a_hash_sees_each_bit_and_its_place():
    numbers = torch.tensor([0.0, 1.0, torch.nan])
    changed = (
        torch.tensor([-0.0, 1.0, torch.nan]),
        torch.tensor([1.0, 0.0, torch.nan]),
        torch.tensor([0.0, 1.0, torch.nan, 0.0, 1.0]),
    )
    hashes = {int(determinism.hash_of(tensor)) for tensor in (numbers, *changed)}
    assert len(hashes) == 4
    assert determinism.hash_of(numbers) == determinism.hash_of(
        torch.stack([numbers, numbers], 1)[:, 1]
    )
    flags = torch.zeros(9, dtype=torch.bool)
    assert determinism.hash_of(flags) != determinism.hash_of(flags.logical_not())


def test_a_large_tensor_is_hashed_in_parts(monkeypatch):
    numbers = torch.arange(100.0)
    whole = determinism.hash_of(numbers)
    monkeypatch.setattr(determinism, "CHUNK", 64)
    assert determinism.hash_of(numbers) == whole


def test_what_is_laid_out_like_the_pool_is_named_and_not_counted():
    found = {1: ["/world/contact.dist"], 2: ["/world/contact.dist", "/world/qpos"]}
    lines = determinism.explain(found)
    assert [line.split(":")[0] for line in lines] == [
        "after iteration 1, in the order of the pool",
        "after iteration 2, in the order of the pool",
        "after iteration 2, 1 differ",
    ]


@pytest.mark.full
def test_the_command_writes_figures_and_hashes(monkeypatch, capsys):
    written = {}
    monkeypatch.setattr(report, "write", lambda name, **what: written.update(what))
    monkeypatch.setattr(determinism, "TASKS", {"tiny": TINY})
    monkeypatch.setattr(
        "sys.argv", ["determinism", "tasks=tiny", "switch=tiny", "iterations=1", "device=cpu"]
    )
    assert determinism.main() == 0
    figures = written["figures"]
    assert figures["cpu/tiny/on_over_off"] > 0.0
    assert figures["cpu/tiny/tensors_that_differ"] == 0 and figures["cpu/tiny/tensors"] > 100
    assert len(set(written["hashes"]["cpu/tiny"])) == 1 and written["first_differences"] == {
        "cpu/tiny": []
    }
    assert "0 of " in capsys.readouterr().out
    for words, message in (
        (["tasks=tinny"], "tasks.*tiny"),
        (["tasks=tiny", "switch=tinny"], "switch.*tiny"),
    ):
        monkeypatch.setattr("sys.argv", ["determinism", *words])
        with pytest.raises(ValueError, match=message):
            determinism.main()
