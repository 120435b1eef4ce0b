"""The stock side of the update's benchmark does what ours does, so that their times can be compared."""

import torch

from benchmarks import report, update


def test_one_update_of_the_stock_parts_ends_where_ours_does():
    device = torch.device("cpu")
    networks = update.make_networks(device)
    rollout_ET = update.make_rollout(networks[0], num_envs=8, device=device)
    assert update.parameter_difference(networks, rollout_ET) < 1e-3
    ends = rollout_ET["next", "done"]
    assert 0.0 < ends.float().mean() < 0.2
    assert (ends == rollout_ET["next", "terminated"] | rollout_ET["next", "truncated"]).all()


def test_figures_of_other_widths_stand_apart(monkeypatch):
    written = {}
    monkeypatch.setattr(report, "write", lambda name, *, figures, **others: written.update(figures))
    monkeypatch.setattr("sys.argv", ["update", "device=cpu", "num_envs=8", "hidden_dims=32,16"])
    monkeypatch.setattr(update, "CPU_REPEATS", 1)
    update.main()
    assert {name.rpartition("/")[0] for name in written} == {"cpu/192/32x16"}
