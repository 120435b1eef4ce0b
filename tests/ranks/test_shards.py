"""A checkpoint of several ranks goes on bit for bit on as many, and is redistributed to others."""

from types import SimpleNamespace

import pytest
import torch

from ksim_rl import conf, ranks
from ksim_rl.cli import run_commands
from ksim_rl.device import state_tree
from ksim_rl.trainers import build
from tests.algorithms.imitation_problems import make_amp
from tests.ranks.gloo import as_ranks_compute, results
from tests.ranks.test_agreement import ALGORITHMS, SMALL


def train(name, folder, num_envs, shards, iterations, resume):
    """Train up to so many iterations, from the newest checkpoint if `resume`, and return all tensors of the end."""
    if name == "amp":
        trainer = make_amp(num_envs=num_envs, shards=shards, iterations=iterations)
    else:
        sizes = [
            f"num_envs={num_envs}",
            f"data.num_env_states_per_minibatch={4 * num_envs}",
            f"data.shards={shards}",
        ]
        overrides = [*SMALL, *ALGORITHMS[name], *sizes, f"trainer.num_iterations={iterations}"]
        trainer = build(conf.compose(overrides))
    trainer.folder = folder
    if resume:
        trainer.load(folder)
    trainer.train()
    return state_tree.split(trainer.state_dict())[0]


@pytest.mark.full
@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_two_ranks_go_on_bit_for_bit(name, tmp_path):
    whole = results(train, name, tmp_path / "a", 4, 1, 3, False, size=2, folder=tmp_path / "whole")
    results(train, name, tmp_path / "b", 4, 1, 2, False, size=2, folder=tmp_path / "first")
    parts = results(train, name, tmp_path / "b", 4, 1, 3, True, size=2, folder=tmp_path / "second")
    for expected, found in zip(whole, parts, strict=True):
        assert all(torch.equal(found[name], tensor) for name, tensor in expected.items())


@pytest.mark.parametrize(
    "name",
    [
        "fast_td3",
        *(pytest.param(name, marks=pytest.mark.full) for name in ("ppo", "sac", "fast_sac", "amp")),
    ],
)
def test_one_to_two_to_one_is_the_run_without_a_break(name, tmp_path, monkeypatch):
    monkeypatch.setattr("tests.shapes.Shaped.fail", lambda *_: None)
    # Sums over all that AMP has seen are too large for 1e-6 in float32.
    with as_ranks_compute(torch.float64 if name == "amp" else torch.float32):
        whole = train(name, tmp_path / "whole", 8, 2, 3, False)
        train(name, tmp_path / "run", 8, 2, 1, False)
        results(train, name, tmp_path / "run", 4, 1, 2, True, size=2, folder=tmp_path / "two")
        found = train(name, tmp_path / "run", 8, 2, 3, True)
    worst = max(
        (found[name].double() - tensor.double()).abs().max().item()
        for name, tensor in whole.items()
        if name.startswith("/update/") and tensor.numel()
    )
    print(f"{name}, 1 to 2 to 1: largest difference {worst:.2g}")
    assert worst <= 1e-6


STYLE = ["task=walker_amp", "objective=amp", "objective.num_transitions_per_step=6"]


def on_these_ranks(overrides, ranks_before):
    cfg = conf.compose([*SMALL, "num_envs=4", "data.num_env_states_per_minibatch=24", *overrides])
    return run_commands._on_these_ranks(
        cfg, SimpleNamespace(state={"ranks": {"size": ranks_before}})
    )


def shared_out(overrides):
    """Return what each of two ranks has of a run in one process."""
    cfg = on_these_ranks(overrides, 1)
    style = getattr(cfg.objective, "num_transitions_per_step", None)
    return cfg.num_envs, cfg.data.num_env_states_per_minibatch, cfg.data.shards, style


@pytest.mark.parametrize(
    ("overrides", "style"), [(["data.shards=2"], None), (["objective=sac"], None), (STYLE, 3)]
)
def test_sizes_are_shared_out(overrides, style, tmp_path):
    expected = (2, 12, 1, style)
    assert results(shared_out, overrides, size=2, folder=tmp_path) == [expected] * 2
    one = on_these_ranks(overrides, 3)
    assert (one.num_envs, one.data.num_env_states_per_minibatch) == (12, 72)
    assert one.data.shards == 3 * (1 + ("data.shards=2" in overrides))


@pytest.mark.parametrize(
    "overrides",
    [
        ["num_envs=5", "data.num_env_states_per_minibatch=20"],
        [*STYLE, "objective.num_transitions_per_step=7"],
    ],
)
def test_sizes_that_cannot_be_shared_out_are_refused(overrides, monkeypatch):
    monkeypatch.setattr("ksim_rl.ranks.shards.size", lambda: 2)
    monkeypatch.setattr(ranks, "size", lambda: 2)
    with pytest.raises(
        ValueError, match="num_.*=[57] on each of 3 ranks .* by 2: resume the run on 3"
    ):
        on_these_ranks(overrides, 3)


def merged(index):
    own = {
        "/env/level": torch.tensor([0.5]),
        "/env/state_E": torch.arange(2) + 2 * index,
        "/update/non_finite_env_states": torch.tensor(3 + index),
        "/env/moments.0.count": torch.tensor(4 + index),
        "/env/moments.0.exact_mean": torch.tensor([1.0 + index], dtype=torch.float64),
        "/env/moments.0.exact_sum_of_squares": torch.tensor([2.0], dtype=torch.float64),
    }
    return ranks.gathered(own), own


def test_checkpoints_are_gathered_and_dealt_out(tmp_path):
    (saved, own), (nothing, second) = results(merged, 0, size=2, folder=tmp_path / "same")
    assert saved == {"size": 2, "parts": {}} == nothing
    (saved, own), (_, second) = results(different, size=2, folder=tmp_path / "different")
    assert "/env/level" not in saved["parts"]["1"], "what is alike is kept once"
    live = own | {"/env/state_E": torch.zeros(4, dtype=torch.int64)}
    found = ranks.dealt(own, saved, live)
    assert found["/env/state_E"].tolist() == [0, 1, 2, 3]
    assert found["/update/non_finite_env_states"] == 7
    # Four values of mean 1 and five of mean 2.
    assert found["/env/moments.0.count"] == 9
    torch.testing.assert_close(
        found["/env/moments.0.exact_mean"], torch.tensor([14.0 / 9.0]).double()
    )
    expected = torch.tensor([4.0 + 20.0 / 9.0]).double()
    torch.testing.assert_close(found["/env/moments.0.exact_sum_of_squares"], expected)
    with pytest.raises(ValueError, match="as many envs as before"):
        ranks.dealt(own, saved, own | {"/env/state_E": torch.zeros(6, dtype=torch.int64)})


def different():
    return merged(ranks.rank())
