import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ksim_rl.device import random
from ksim_rl.transforms import DelayCfg, ObservationDelay
from tests.transforms.chains import VECTOR, counter, fixed_rollout


@st.composite
def delays(draw):
    min_lag = draw(st.integers(0, 4))
    every = draw(st.integers(0, 4))
    return DelayCfg(
        min_lag=min_lag,
        max_lag=min_lag + draw(st.integers(0, 3)),
        per_env=draw(st.booleans()),
        resample_every=every,
        hold_probability=draw(st.sampled_from([0.0, 0.5, 1.0])) if every else 0.0,
    )


def check_against_closed_form(delay, lengths, seed, steps=14):
    """A counter shows how old each reading is: max(count - lag, 0), with the lag that the transform reports."""
    env = counter(ObservationDelay(VECTOR, "delayed", delay=delay), lengths=lengths)
    env.set_seed(seed)
    transform = env.transform[0]
    root = env.reset()
    lag = transform.lag_E.clone()
    for clock in range(1, steps + 1):
        stepped, root = env.step_and_maybe_reset(
            root.set("action", torch.zeros(env.action_spec.shape))
        )
        count, done = stepped["next", "count"][:, 0].long(), stepped["next", "done"][:, 0]
        reached = stepped["next", "delayed"][:, 0].long()
        age = count - reached
        now = transform.lag_E
        assert bool((now >= delay.min_lag).all()) and bool((now <= delay.max_lag).all())
        # Within the episode the lag changes only when a draw is due.
        clocks = count if delay.per_env else torch.full_like(count, clock)
        due = clocks % delay.resample_every == 0 if delay.resample_every else torch.zeros_like(done)
        if delay.per_env or not bool(done.any()):
            goes_on = ~done
            assert torch.equal(age[goes_on], torch.minimum(now, count)[goes_on])
            may_change = due & (delay.hold_probability < 1.0)
            assert bool((now == lag)[goes_on & ~may_change].all())
        if not delay.per_env:
            assert bool((now == now[0]).all())
            clock_restarts = bool(done.all())
            if clock_restarts:
                return
        fresh = root["delayed"][:, 0]
        assert bool((fresh[done] == 0).all()), "an env that just reset sees its reset observation"
        assert torch.equal(
            stepped["next", "delayed"] - reached[:, None],
            torch.tensor([0.0, 100.0, 200.0]).expand(len(lengths), 3),
        )
        lag = now.clone()


cases = given(
    delay=delays(),
    lengths=st.lists(st.integers(1, 7), min_size=1, max_size=4),
    seed=st.integers(0, 2**31 - 1),
)


@cases
@settings(max_examples=60, deadline=None, derandomize=True)
def test_delayed_counts_in_closed_form(delay, lengths, seed):
    check_against_closed_form(delay, lengths, seed)


@pytest.mark.full
@cases
@settings(max_examples=1000, deadline=None, derandomize=True)
def test_delayed_counts_in_closed_form_1000_cases(delay, lengths, seed):
    check_against_closed_form(delay, lengths, seed)


def test_a_fixed_lag_is_exact_over_resets():
    env = counter(
        ObservationDelay("count", "delayed", delay=DelayCfg(min_lag=2, max_lag=2)),
        lengths=(3, 5, 1, 20),
    )
    rollout_ET = fixed_rollout(env, 18)
    for part in (rollout_ET, rollout_ET["next"]):
        assert torch.equal(part["delayed"], (part["count"] - 2).clamp(min=0))


def test_lag_zero_changes_nothing():
    rollout_ET = fixed_rollout(
        counter(ObservationDelay(VECTOR, "delayed", delay=DelayCfg(max_lag=0))), 9
    )
    assert torch.equal(rollout_ET["delayed"], rollout_ET[VECTOR])


def lags(delay, num_envs=2000, steps=60, length=10):
    env = counter(ObservationDelay("count", "delayed", delay=delay), lengths=(length,) * num_envs)
    root = env.reset()
    found = []
    for _ in range(steps):
        _, root = env.step_and_maybe_reset(root.set("action", torch.zeros(num_envs, 2)))
        found.append(env.transform[0].lag_E.clone())
    return torch.stack(found, 1)


def assert_frequency(hits, probability):
    n = hits.numel()
    assert abs(hits.float().mean() - probability) < 4 * math.sqrt(
        probability * (1 - probability) / n
    )


def test_lags_are_uniform_and_drawn_anew_at_each_reset():
    # The lag that holds after step 10 k belongs to the next episode.
    drawn = lags(DelayCfg(min_lag=1, max_lag=4))[:, 9::10]
    for lag in range(1, 5):
        assert_frequency(drawn == lag, 0.25)
    assert_frequency(drawn[:, 1:] == drawn[:, :-1], 0.25)


def test_lags_of_a_reset_are_the_keyed_draws_of_the_rows_that_reset():
    delay = ObservationDelay(
        "count", "delayed", delay=DelayCfg(min_lag=2, max_lag=9), seed=11, stream="imu"
    )
    env = counter(delay, lengths=(50,) * 5)
    env.reset()
    before = delay.lag_E.clone()
    env.reset(env_ids=[1, 3])
    resets_E = torch.tensor([1, 2, 1, 2, 1])
    assert torch.equal(delay.reset_count_E, resets_E)
    keys = random.row_keys(torch.tensor(11), random.stream_id("imu/reset/lag"), resets_E, 5)
    assert torch.equal(delay.lag_E, random.integers(keys, 1, 2, 9)[:, 0])
    assert torch.equal(delay.lag_E[::2], before[::2])


def test_hold_probability_is_the_share_of_draws_that_change_nothing():
    found = lags(DelayCfg(max_lag=7, resample_every=2, hold_probability=0.75), length=1000)
    same = found[:, 1:] == found[:, :-1]
    # found[:, i] is the lag after step i + 1: draws happen at even steps.
    assert bool(same[:, 1::2].all())
    assert_frequency(same[:, 0::2], 0.75 + 0.25 / 8)


def test_a_shared_lag_is_one_number_that_single_resets_leave_alone():
    found = lags(DelayCfg(max_lag=30, per_env=False), num_envs=3, steps=30, length=1000)
    assert bool((found == found[0, 0]).all())
    env = counter(
        ObservationDelay("count", delay=DelayCfg(max_lag=1000, per_env=False)), lengths=(100,) * 3
    )
    env.reset()
    lag = env.transform[0].lag_E.clone()
    env.reset(env_ids=[1])
    assert torch.equal(env.transform[0].lag_E, lag)
    env.reset()
    assert bool((env.transform[0].lag_E != lag).all())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"max_lag": -1}, "max_lag=-1"),
        ({"max_lag": 1.5}, "max_lag=1.5"),
        ({"min_lag": 3, "max_lag": 2}, "min_lag=3 exceeds max_lag=2"),
        ({"max_lag": 2, "resample_every": 2, "hold_probability": 1.5}, "hold_probability=1.5"),
        ({"max_lag": 2, "hold_probability": 0.5}, "without resample_every"),
    ],
)
def test_wrong_values_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        DelayCfg(**arguments)
