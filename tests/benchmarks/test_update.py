"""The stock side of the update's benchmark does what ours does, so that their times can be compared."""

import torch

from benchmarks import update


def test_one_update_of_the_stock_parts_ends_where_ours_does():
    precision = torch.get_float32_matmul_precision()
    device = torch.device("cpu")
    networks = update.make_networks(device)
    rollout_ET = update.make_rollout(networks[0], num_envs=8, device=device)
    try:
        assert update.parameter_difference(networks, rollout_ET) < 1e-3
    finally:
        torch.set_float32_matmul_precision(precision)
    ends = rollout_ET["next", "done"]
    assert 0.0 < ends.float().mean() < 0.2
    assert (ends == rollout_ET["next", "terminated"] | rollout_ET["next", "truncated"]).all()
