"""Slow sensors that miss readings, against when a reading arrived, which the counter env tells."""

import pytest
import torch

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import DelayCfg, ObservationDelay, ObservationHold
from tests.transforms.chains import fixed_rollout


def rollout(*transforms, lengths=(40, 40, 40, 40, 9), steps=36):
    env = MaskedTransformedEnv(CounterEnv(lengths, picture=(4, 5, 3)), list(transforms))
    env.set_seed(3)
    return fixed_rollout(env, steps)


@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize("dropped", [0.0, 0.3])
def test_what_is_shown_is_what_arrived_last(every, dropped):
    if every == 1 and not dropped:
        with pytest.raises(ValueError, match="nothing would be held"):
            ObservationHold("count", every=every)
        return
    hold = ObservationHold(
        ["count", "rgb"], ["seen", "picture"], every=every, dropped=dropped, fresh_key="fresh"
    )
    rollout_ET = rollout(hold)
    count_ET = rollout_ET["count"][..., 0]
    seen_ET = rollout_ET["seen"][..., 0]
    fresh_ET = rollout_ET["fresh"][..., 0].bool()
    # At a reset its own; then the present one if fresh, else the one before.
    assert bool(fresh_ET[count_ET == 0].all())
    assert torch.equal(seen_ET[fresh_ET], count_ET[fresh_ET])
    stale_ET = ~fresh_ET[:, 1:]
    assert torch.equal(seen_ET[:, 1:][stale_ET], seen_ET[:, :-1][stale_ET])
    # The picture came with it, in bytes.
    byte_HWC = torch.arange(60).view(4, 5, 3)
    expected = (40 * seen_ET.long()[..., None, None, None] + byte_HWC) % 256
    assert torch.equal(rollout_ET["picture"], expected.to(torch.uint8))
    arrivals = [count_ET[env][fresh_ET[env]][1:] for env in range(4)]
    for counts in arrivals:
        assert counts[0] >= 1 if dropped else 1 <= counts[0] <= every
        assert bool(((counts[1:] - counts[0]) % every == 0).all())
    if not dropped:
        assert all(bool((counts.diff() == every).all()) for counts in arrivals)
        assert len({int(counts[0]) for counts in arrivals}) > 1 or every == 1
    else:
        share = sum(len(counts) for counts in arrivals) / (4 * 35 / every)
        assert share == pytest.approx(1 - dropped, abs=0.2)


def test_a_delay_behind_it_is_the_lag_of_the_camera():
    hold = ObservationHold("count", "held", every=4, fresh_key="fresh")
    lag = DelayCfg(min_lag=1, max_lag=3)
    # The flag travels with its picture: it belongs to the one that is shown.
    delay = ObservationDelay(["held", "fresh"], ["late", "late_fresh"], delay=lag)
    rollout_ET = rollout(hold, delay)
    held_ET, late_ET = rollout_ET["held"][:4], rollout_ET["late"][:4]
    lag_E = delay.lag_E[:4]
    assert len(set(lag_E.tolist())) > 1
    for env, lag in enumerate(lag_E.tolist()):
        assert torch.equal(late_ET[env, lag:], held_ET[env, :-lag])
    is_new_ET = rollout_ET["late_fresh"][:4, 4:, 0].bool()
    assert torch.equal(is_new_ET, (late_ET.diff(dim=1) != 0)[:, 3:, 0])
