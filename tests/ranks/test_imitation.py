"""AMP and distillation learn on several ranks what one process learns: problems of pure torch, joined by gloo."""

import pytest
import torch

from ksim_rl.device import state_tree
from tests.algorithms.imitation_problems import make_amp, make_distillation
from tests.ranks.gloo import results
from tests.ranks.test_agreement import largest_difference

ALGORITHMS = {
    "amp": (make_amp, {}),
    "distillation": (make_distillation, {"teacher_share": 0.5}),
    "distillation_mse": (make_distillation, {"loss": "mse", "schedule": "fixed"}),
}


@pytest.fixture(autouse=True)
def one_thread():
    """Train as each of the forked ranks does."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def learnt(name, num_envs, shards):
    """Return the tensors of an update after three iterations."""
    make, cfg = ALGORITHMS[name]
    trainer = make(num_envs=num_envs, shards=shards, cfg=cfg, iterations=3)
    trainer.train()
    return state_tree.split(trainer.update.state_dict())[0]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_two_ranks_learn_what_one_process_learns(name, tmp_path):
    whole = learnt(name, 32, 2)
    parts = results(learnt, name, 16, 1, size=2, folder=tmp_path)
    worst = largest_difference(whole, parts)
    print(f"{name}, 2 ranks: {len(whole)} tensors, largest difference {worst:.2g}")
    assert worst <= 1e-6
    if name == "amp":
        count = "/discriminator/normalizer.count"
        assert sum(part[count] for part in parts) == whole[count], "each counts its share of the motions"


def test_shards_of_another_size_are_refused():
    with pytest.raises(ValueError, match="shards=2: use a divisor of num_envs=32 and of minibatches of 33"):
        make_amp(num_envs=32, shards=2, cfg={"num_transitions_per_step": 33})
