"""Recorded episodes become a replay, from which each minibatch takes its share."""

import pytest
import torch
from tensordict import TensorDict

from ksim_rl.data import OfflineCfg, ReplayCfg, ReplayRing, make_offline_table
from ksim_rl.data.dataset_storage import MASK_KEY
from ksim_rl.device import room
from ksim_rl.testing import count_syncs

LENGTHS = (5, 1, 3, 4)
GAMMA = 0.5
SHARED = {"observations": ["actor"], "gamma": GAMMA}


def recording(lengths=LENGTHS):
    """Env states whose observation is 10 * episode + step; every second episode is cut off by the clock."""
    rows = []
    for episode, length in enumerate(lengths):
        for step in range(length):
            is_last = step == length - 1
            rows.append(
                {
                    "actor": [10.0 * episode + step],
                    "action": [0.1 * len(rows)],
                    "next": {
                        "actor": [10.0 * episode + step + 1],
                        "reward": [float(len(rows) + 1)],
                        "done": [is_last],
                        "terminated": [is_last and episode % 2 == 0],
                    },
                    "episode": episode,
                }
            )
    return torch.stack([TensorDict(row) for row in rows])


def expected(row, rows_D, n_step):
    """Sum rewards from a row on as the definition has it; return action, reward, successor, flags and steps."""
    total = 0.0
    for step in range(n_step):
        at = rows_D[row + step]
        total += GAMMA**step * at["next", "reward"].item()
        if at["next", "done"].item():
            break
    flags = [at["next", name].item() for name in ("done", "terminated")]
    return [rows_D[row]["action"].item(), total, at["next", "actor"].item(), *flags, step + 1]


@pytest.mark.parametrize(("n_step", "shards"), [(1, 1), (3, 1), (3, 2)])
def test_all_that_is_drawn_is_what_was_recorded(n_step, shards):
    rows_D = recording()
    storage = make_offline_table(rows_D, n_step=n_step, shards=shards, **SHARED).storage
    index_N = storage.available.nonzero()[:, 0]
    found_N = storage.get(index_N)
    assert sorted(found_N["actor"][:, 0].tolist()) == sorted(rows_D["actor"][:, 0].tolist())
    for found in found_N:
        row = rows_D["actor"][:, 0].tolist().index(found["actor"].item())
        following = found["next"]
        numbers = [found["action"].item(), following["reward"].item(), following["actor"].item()]
        flags = [following["done"].item(), following["terminated"].item()]
        assert [*numbers, *flags, found["steps_to_next_obs"].item()] == pytest.approx(
            expected(row, rows_D, n_step)
        )
    # Episodes are whole in their shard, and shards about equal.
    shard_N = index_N % shards
    sizes = shard_N.bincount().tolist()
    assert max(sizes) - min(sizes) <= max(LENGTHS)
    episode_N = (found_N["actor"][:, 0] // 10).to(torch.int64)
    assert len({(int(a), int(b)) for a, b in zip(episode_N, shard_N, strict=True)}) == len(LENGTHS)


def ring_of(rows_D, *, size=8, share=0.25, shards=1, save_replay=True):
    cfg = ReplayCfg(
        num_env_states_per_minibatch=size,
        num_minibatches=400,
        capacity=20,
        shards=shards,
        offline=OfflineCfg(source="made_up", share=share),
        save_replay=save_replay,
    )
    ring = ReplayRing(cfg, num_envs=2, **SHARED)
    ring.offline = make_offline_table(rows_D, shards=shards, **SHARED)
    # Two envs of five steps, whose observations are negative.
    online_ET = recording([10]).exclude("episode").reshape(2, 5)
    for key in ("actor", ("next", "actor")):
        online_ET[key] -= 100.0
    ring.extend(online_ET)
    return ring


@pytest.mark.parametrize("shards", [1, 2])
def test_minibatches_have_their_share_and_draw_each_env_state_alike(shards):
    torch.manual_seed(0)
    rows_D = recording()
    ring = ring_of(rows_D, size=16, share=0.5, shards=shards)
    with count_syncs() as syncs:
        minibatches = list(ring.minibatches(400))
    assert syncs.total == 0, syncs.report()
    drawn = []
    for minibatch_B in minibatches:
        # Places without an env state are masked: after four draws hardly any.
        mask_B = minibatch_B[MASK_KEY][:, 0]
        is_recorded_B = minibatch_B["actor"][:, 0] >= 0.0
        # One half behind the other, in each shard.
        expected_B = torch.arange(16) % (16 // shards) >= 8 // shards
        assert (is_recorded_B == expected_B)[mask_B].all()
        drawn += minibatch_B["actor"][expected_B & mask_B, 0].tolist()
    times = [drawn.count(seen) for seen in rows_D["actor"][:, 0].tolist()]
    # 3200 draws of 13 env states; with two shards one has six of them, and the other seven.
    assert sum(times) > 3100 and min(times) > 180 and max(times) < 320, times


def test_a_replay_goes_on_with_the_same_recording_only():
    ring = ring_of(recording())
    again = ring_of(recording())
    again.load_state_dict(ring.state_dict())
    drawn = []
    for each in (ring, again):
        torch.manual_seed(1)
        drawn.append(torch.cat(list(each.minibatches(3))))
    assert (drawn[0] == drawn[1]).all()
    other = recording()
    other["next", "reward"][3] += 1.0
    # Whether or not the replay itself is saved.
    without = ring_of(recording(), save_replay=False)
    for saved in (ring.state_dict(), without.state_dict()):
        with pytest.raises(ValueError, match="another recording than the checkpoint's"):
            ring_of(other).load_state_dict(saved)
    again.load_state_dict(without.state_dict())
    assert again.num_stored == 0


def test_rows_that_are_not_finite_are_counted_and_never_drawn():
    rows_D = recording()
    rows_D["next", "reward"][2] = float("nan")
    rows_D["actor"][9] = float("inf")  # also the successor of row 8
    rows_D["next", "actor"][8] = float("inf")
    storage = make_offline_table(rows_D, **SHARED).storage
    assert storage.non_finite_count == 3 and storage.available.sum() == len(rows_D) - 3
    assert all(leaf.isfinite().all() for leaf in storage.content.values(True, True))


def spoilt(key, row, value):
    rows_D = recording()
    rows_D[key][row] = value
    return rows_D


@pytest.mark.parametrize(
    ("rows_D", "shards", "message"),
    [
        (spoilt(("next", "done"), 4, False), 1, "'next/done' of env state 4 is False, .* ends"),
        (spoilt(("next", "done"), 2, True), 1, "'next/done' of env state 2 is True, .* goes on"),
        (spoilt("actor", 3, 7.0), 1, "'actor' after env state 2 is not what its 'next' says"),
        (recording(), 8, "4 episodes cannot be shared by 8 shards"),
    ],
)
def test_what_it_refuses(rows_D, shards, message):
    with pytest.raises(ValueError, match=message):
        make_offline_table(rows_D, shards=shards, **SHARED)


def test_what_no_memory_holds_is_refused(monkeypatch):
    monkeypatch.setattr(room, "total_bytes", lambda device: 100)
    said = (
        "^13 recorded env states: takes at least 0 GB of memory, and cpu has 0.0 GB: record fewer"
    )
    with pytest.raises(ValueError, match=said):
        make_offline_table(recording(), **SHARED)
    # Each alone would fit: 17 places of 14 bytes or more, and the replay.
    monkeypatch.setattr(room, "total_bytes", lambda device: 1000)
    make_offline_table(recording(), **SHARED)
    with pytest.raises(ValueError, match="beside the replay: .* or lower data.capacity"):
        make_offline_table(recording(), beside=900, **SHARED)


@pytest.mark.parametrize(
    ("share", "others", "message"),
    [
        (0.3, {}, r"offline.share=0.3 of num_env_states_per_minibatch=8 is no whole number"),
        (1.0, {}, r"offline.share=1.0 of"),
        (0.5, {"prioritized": True}, "prioritized=True with offline"),
    ],
)
def test_shares_that_cannot_be_are_refused(share, others, message):
    with pytest.raises(ValueError, match=message):
        ReplayCfg(
            num_env_states_per_minibatch=8,
            num_minibatches=1,
            offline=OfflineCfg(source="made_up", share=share),
            **others,
        )
