import pytest
import torch
from tensordict import TensorDict

from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    ObservationNormalizer,
    make_actor,
    make_critic,
    update_normalizers,
)
from ksim_rl.testing import count_syncs


def _batches(dim=4, sizes=((3, 5), (1,), (7, 2, 3), (400,))):
    shift = torch.tensor([0.0, 100.0, -3.0, 1e-3])
    scale = torch.tensor([1.0, 0.01, 30.0, 1e-4])
    return [torch.randn(*size, dim) * scale + shift for size in sizes]


def test_statistics_equal_two_pass_mean_and_variance():
    normalizer, batches = ObservationNormalizer(4), _batches()
    for batch in batches:
        normalizer.update(batch)
    seen = torch.cat([batch.flatten(0, -2) for batch in batches]).double()
    assert int(normalizer.count) == len(seen)
    torch.testing.assert_close(normalizer.mean, seen.mean(0).float())
    torch.testing.assert_close(normalizer.var, seen.var(0, unbiased=False).float())


def test_how_batches_are_split_does_not_matter():
    obs = torch.randn(64, 4) * 5 + 2
    whole, parts = ObservationNormalizer(4), ObservationNormalizer(4)
    whole.update(obs)
    for part in obs.split(7):
        parts.update(part)
    torch.testing.assert_close(whole.exact_mean, parts.exact_mean)
    torch.testing.assert_close(whole.exact_sum_of_squares, parts.exact_sum_of_squares)


def test_forward_normalizes_and_never_updates():
    normalizer = ObservationNormalizer(4, eps=1e-6)
    obs = torch.randn(1000, 4) * torch.tensor([1.0, 2.0, 3.0, 4.0]) + 10
    assert torch.allclose(normalizer(obs), obs, atol=1e-3), "identity before the first update"
    normalizer.update(obs)
    before = {name: buffer.clone() for name, buffer in normalizer.named_buffers()}
    out = normalizer(obs)
    torch.testing.assert_close(out.mean(0), torch.zeros(4), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(out.std(0, unbiased=False), torch.ones(4), atol=1e-4, rtol=0.0)
    for name, buffer in normalizer.named_buffers():
        assert torch.equal(buffer, before[name])


def test_a_constant_component_stays_finite_and_small():
    normalizer = ObservationNormalizer(1)
    normalizer.update(torch.full((100, 1), 3.0))
    assert normalizer(torch.full((1, 1), 3.0)).item() == 0.0
    assert normalizer(torch.full((1, 1), 3.01)).item() == pytest.approx(1.0, rel=1e-4)


def test_float64_statistics_do_not_stagnate():
    normalizer = ObservationNormalizer(1)
    normalizer.count.fill_(10**9)
    normalizer.exact_mean.fill_(1.0)
    normalizer.update(torch.full((10, 1), 2.0))
    assert normalizer.exact_mean.item() == pytest.approx(1.0 + 10 / (10**9 + 10), rel=1e-15)
    assert int(normalizer.count) == 10**9 + 10


def test_rows_that_are_not_finite_or_not_valid_are_left_out():
    obs = torch.randn(6, 5, 4)
    valid = torch.rand(6, 5) < 0.7
    dirty = obs.clone()
    dirty[2, 3, 1] = float("nan")
    dirty[4, 0, 2] = float("inf")
    keep = valid.clone()
    keep[2, 3] = keep[4, 0] = False
    for mask in (valid, valid.unsqueeze(-1)):
        normalizer = ObservationNormalizer(4)
        normalizer.update(dirty, valid=mask)
        torch.testing.assert_close(normalizer.mean, obs[keep].mean(0))
        torch.testing.assert_close(normalizer.var, obs[keep].var(0, unbiased=False))
        assert int(normalizer.count) == int(keep.sum())


def test_an_update_without_a_valid_row_changes_nothing():
    for warm in (False, True):
        normalizer = ObservationNormalizer(4)
        if warm:
            normalizer.update(torch.randn(9, 4))
        before = {name: buffer.clone() for name, buffer in normalizer.named_buffers()}
        normalizer.update(torch.full((5, 4), float("nan")))
        for name, buffer in normalizer.named_buffers():
            assert torch.equal(buffer, before[name]), name


def test_until_stops_counting():
    normalizer = ObservationNormalizer(2, until=10)
    for _ in range(5):
        normalizer.update(torch.randn(4, 2))
    assert int(normalizer.count) == 12


def test_time_major_memory_gives_the_same():
    obs = torch.randn(5, 6, 4)
    one, other = ObservationNormalizer(4), ObservationNormalizer(4)
    valid = torch.rand(6, 5) < 0.5
    one.update(obs.transpose(0, 1), valid)
    other.update(obs.transpose(0, 1).contiguous(), valid)
    torch.testing.assert_close(one.mean, other.mean)


def test_state_dict_round_trip_continues_exactly():
    normalizer, twin = ObservationNormalizer(4), ObservationNormalizer(4)
    first, second = torch.randn(8, 4), torch.randn(8, 4)
    normalizer.update(first)
    twin.load_state_dict(normalizer.state_dict())
    for one in (normalizer, twin):
        one.update(second)
    for name, buffer in normalizer.named_buffers():
        assert torch.equal(buffer, twin.get_buffer(name))


def test_update_and_forward_keep_addresses_and_make_no_host_sync():
    normalizer, obs = ObservationNormalizer(4, until=10**6), torch.randn(6, 4)
    addresses = [buffer.data_ptr() for buffer in normalizer.buffers()]
    with count_syncs() as syncs:
        normalizer.update(obs, torch.ones(6, dtype=torch.bool))
        normalizer(obs)
    assert syncs.total == 0, syncs.report()
    assert addresses == [buffer.data_ptr() for buffer in normalizer.buffers()]


def test_update_normalizers_counts_each_env_state_once():
    actor = make_actor(ActorCfg(hidden_dims=(8,)), obs_dim=3, action_dim=2)
    critic = make_critic(CriticCfg(hidden_dims=(8,)), obs_dim=5)
    plain = make_critic(CriticCfg(hidden_dims=(8,), obs_normalization=False), obs_dim=5)
    data = TensorDict({"actor": torch.randn(4, 6, 3), "critic": torch.randn(4, 6, 5)}, [4, 6])
    update_normalizers(data, actor, critic, critic, plain)
    counts = {
        name: int(buffer)
        for module in (actor, critic)
        for name, buffer in module.named_buffers()
        if name.endswith("count")
    }
    assert set(counts.values()) == {24}
    normalizer = critic.module.normalizer
    torch.testing.assert_close(normalizer.mean, data["critic"].flatten(0, 1).mean(0))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ObservationNormalizer(3).update(torch.zeros(2, 4)), r"\(2, 4\).*must be 3"),
        (
            lambda: ObservationNormalizer(3).update(torch.zeros(2, 3), torch.ones(3).bool()),
            r"\(3,\).*\(2, 3\)",
        ),
        (lambda: ObservationNormalizer(3, eps=0.0), "eps=0.0"),
        (lambda: ObservationNormalizer(3, until=0), "until=0"),
    ],
)
def test_refusals_have_the_numbers(call, message):
    with pytest.raises(ValueError, match=message):
        call()
