"""AMP and distillation learn on several ranks what one process learns: problems of pure torch, joined by gloo."""

import pytest
import torch

from ksim_rl.data.replay_ring import ReplaySampler
from ksim_rl.device import state_tree
from tests.algorithms.imitation_problems import make_amp, make_distillation
from tests.ranks.gloo import as_ranks_compute, results
from tests.ranks.test_agreement import largest_difference

ALGORITHMS = {
    "amp": (make_amp, {}),
    "distillation": (make_distillation, {"teacher_share": 0.5}),
    "distillation_mse": (make_distillation, {"loss": "mse", "schedule": "fixed"}),
}


def learnt(name, num_envs, shards, iterations):
    """Return the tensors of an update after so many iterations."""
    make, cfg = ALGORITHMS[name]
    trainer = make(num_envs=num_envs, shards=shards, cfg=cfg, iterations=iterations)
    trainer.train()
    return state_tree.split(trainer.update.state_dict())[0]


def compared(name, size, folder, *, dtype=torch.float32):
    """Train on ranks and in one process; return how many tensors were compared, and their largest difference.

    That is after three iterations; for AMP in float32 after one, as each about trebles differences of rounding: policy
    and discriminator learn from each other.
    """
    iterations = 1 if (name, dtype) == ("amp", torch.float32) else 3
    with as_ranks_compute(dtype):
        whole = learnt(name, 16 * size, size, iterations)
        parts = results(learnt, name, 16, 1, iterations, size=size, folder=folder)
    if name == "amp":
        count = "/discriminator/normalizer.count"
        assert sum(part[count] for part in parts) == whole[count], (
            "each counts its share of the motions"
        )
    return len(whole), largest_difference(whole, parts)


@pytest.mark.parametrize(
    ("name", "size"),
    [(name, 2) for name in ALGORITHMS]
    + [pytest.param(name, 4, marks=pytest.mark.full) for name in ALGORITHMS],
)
def test_ranks_learn_what_one_process_learns(name, size, tmp_path):
    tensors, worst = compared(name, size, tmp_path)
    places = worst / torch.finfo(torch.float32).eps
    print(f"{name}, {size} ranks: {tensors} tensors, largest difference {places:.1f} last places")
    # AMP with 4 ranks differs by 14 places in float32, and by 8 in float64: rounding, which grows as learning goes on.
    assert places <= (16 if name == "amp" else 8)


@pytest.mark.parametrize("size", [2, pytest.param(4, marks=pytest.mark.full)])
def test_amp_agrees_in_float64_where_env_states_are_left_out(size, tmp_path, monkeypatch):
    # The annotations say float32.
    monkeypatch.setattr("tests.shapes.Shaped.fail", lambda *_: None)
    # So that minibatches have places without an env state, not as many on each rank.
    monkeypatch.setitem(ReplaySampler.__init__.__kwdefaults__, "tries", 1)
    tensors, worst = compared("amp", size, tmp_path, dtype=torch.float64)
    print(f"amp in float64, {size} ranks: {tensors} tensors, largest difference {worst:.2g}")
    assert worst <= 1e-12


def test_shards_of_another_size_are_refused():
    with pytest.raises(
        ValueError, match="shards=2: use a divisor of num_envs=32 and of minibatches of 33"
    ):
        make_amp(num_envs=32, shards=2, cfg={"num_transitions_per_step": 33})
