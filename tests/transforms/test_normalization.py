import pytest
import torch
import torch.multiprocessing as mp
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs.transforms import ObservationNorm

from ksim_rl.transforms import ObservationNormalization
from tests.transforms.chains import VECTOR, counter, fixed_rollout

LENGTHS = (3, 5, 4, 7)


def env_states(rollout_ET, key):
    """Return each env state once, the reached ones and the resets, [N, L] in float64."""
    first = torch.zeros_like(rollout_ET["done"][..., 0])
    first[:, 0] = True
    first[:, 1:] = rollout_ET["next", "done"][:, :-1, 0]
    return torch.cat((rollout_ET["next", key].flatten(0, 1), rollout_ET[key][first])).double()


@pytest.mark.parametrize("stock", [False, True])
def test_each_env_state_counts_once_and_equals_two_passes(stock):
    env = counter(
        ObservationNormalization([VECTOR, "drawn"], ["a", "b"], eps=1e-6),
        lengths=LENGTHS,
        stock=stock,
    )
    rollout_ET = fixed_rollout(env, 19)
    env.transform[0].enable_(False)
    states = {key: env_states(rollout_ET, key) for key in (VECTOR, "drawn")}
    for moments, seen in zip(env.transform[0].moments, states.values(), strict=True):
        # The last step's resets have not happened: the rollout ended before them.
        assert int(moments.count) == len(seen)
        torch.testing.assert_close(moments.exact_mean, seen.mean(0), rtol=1e-12, atol=0)
        variance = moments.exact_sum_of_squares / moments.count
        torch.testing.assert_close(variance, seen.var(0, unbiased=False), rtol=1e-12, atol=0)


def test_what_a_step_returns_counts_already():
    env = counter(ObservationNormalization(VECTOR, "a"), lengths=(50,) * 20)
    rollout_ET = fixed_rollout(env, 5)
    seen = torch.cat((rollout_ET[VECTOR][:, :1], rollout_ET["next", VECTOR]), dim=1).double()
    for step in range(5):
        so_far = seen[:, : step + 2].flatten(0, 1)
        std = (so_far.var(0, unbiased=False) + 1e-4).sqrt()
        expected = (seen[:, step + 1] - so_far.mean(0)) / std
        torch.testing.assert_close(
            rollout_ET["next", "a"][:, step].double(), expected, rtol=1e-4, atol=1e-4
        )


def test_frozen_it_equals_torchrls_norm():
    ours = ObservationNormalization(VECTOR, "ours", eps=1e-4)
    env = counter(ours, lengths=LENGTHS)
    fixed_rollout(env, 10)
    env.eval()
    moments = ours.moments[0]
    scale = (moments.var + 1e-4).sqrt()
    env.append_transform(
        ObservationNorm(
            moments.mean.clone(), scale, in_keys=[VECTOR], out_keys=["theirs"], standard_normal=True
        )
    )
    env.eval()
    before = {name: value.clone() for name, value in ours.state_dict().items()}
    rollout_ET = fixed_rollout(env, 8)
    torch.testing.assert_close(rollout_ET["ours"], rollout_ET["theirs"])
    assert all(torch.equal(ours.state_dict()[name], value) for name, value in before.items())
    env.train()
    env.rollout(2)
    assert int(moments.count) > int(before["moments.0.count"])


def test_until_stops_it():
    env = counter(ObservationNormalization(VECTOR, until=8), lengths=LENGTHS)
    env.rollout(30, break_when_any_done=False)
    assert int(env.transform[0].moments[0].count) == 8


def test_a_replay_buffer_gets_the_statistics_as_they_are():
    env = counter(ObservationNormalization("count"))
    env.rollout(10, break_when_any_done=False)
    transform = ObservationNormalization("count")
    transform.load_state_dict(env.transform[0].state_dict())
    buffer = ReplayBuffer(storage=LazyTensorStorage(4), batch_size=4)
    buffer.extend(TensorDict({"count": torch.arange(4.0)[:, None]}, batch_size=4))
    buffer.append_transform(transform)
    found, moments = buffer.sample()["count"], env.transform[0].moments[0]
    every = (torch.arange(4.0)[:, None] - moments.mean) / (moments.var + 1e-4).sqrt()
    assert all(bool(torch.isclose(value, every).any()) for value in found)
    assert torch.equal(transform.moments[0].count, moments.count)


def rank(index, folder):
    torch.distributed.init_process_group("gloo", f"file://{folder}/store", rank=index, world_size=2)
    lengths = LENGTHS if index == 0 else (2, 6)
    env = counter(ObservationNormalization([VECTOR, "drawn"], ["a", "b"]), lengths=lengths)
    env.set_seed(index)
    rollout_ET = fixed_rollout(env, 12)
    if index == 0:
        # Alone and frozen, as in an evaluation: nothing waits for the other rank.
        env.eval()
        env.rollout(3)
    states = {key: env_states(rollout_ET, key) for key in (VECTOR, "drawn")}
    torch.save((states, env.transform[0].state_dict()), f"{folder}/{index}.pt")
    torch.distributed.destroy_process_group()


def test_two_ranks_share_their_statistics(tmp_path):
    mp.start_processes(rank, (str(tmp_path),), nprocs=2, start_method="fork")
    (states_0, ours), (states_1, theirs) = (torch.load(tmp_path / f"{i}.pt") for i in range(2))
    for index, key in enumerate((VECTOR, "drawn")):
        # Resets count at once, and are merged with the step that follows.
        seen = torch.cat((states_0[key], states_1[key]))
        for part, expected in (("mean", seen.mean(0)), ("var", seen.var(0, unbiased=False))):
            name = f"moments.{index}.{part}"
            assert torch.equal(ours[name], theirs[name])
            torch.testing.assert_close(ours[name].double(), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ObservationNormalization("a", eps=0.0), "eps=0.0"),
        (lambda: ObservationNormalization("a", until=0), "until=0"),
        (lambda: ObservationNormalization(["a", "b"], ["c"]), "out_keys"),
    ],
)
def test_wrong_values_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()
