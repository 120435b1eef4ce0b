"""The ring against a plain list of what happened."""

import pytest
import torch
from tensordict import TensorDict

from ksim_rl.data import MASK_KEY, ReplayCfg, ReplayRing, ReplayStorage
from ksim_rl.device.memory import refused_bytes
from ksim_rl.testing import count_syncs

NUM_ENVS, CAPACITY, GAMMA = 3, 20, 0.9


class _History:
    """Makes rollouts of random episodes, and remembers each env state with all that ever followed it."""

    def __init__(self, seed=0, *, end=0.3):
        self.generator = torch.Generator().manual_seed(seed)
        self.end = end
        self.count = 0
        self.obs = [self._fresh() for _ in range(NUM_ENVS)]
        self.log = [[] for _ in range(NUM_ENVS)]

    def _fresh(self):
        self.count += 1
        return float(self.count)

    def rollout(self, length):
        steps = []
        for _ in range(length):
            rows = []
            for env in range(NUM_ENVS):
                chance = torch.rand(3, generator=self.generator).tolist()
                done, terminated = chance[0] < self.end, chance[0] < self.end / 2
                row = {
                    "obs": self.obs[env],
                    "action": -self.obs[env],
                    "reward": chance[1],
                    "following": self._fresh(),
                    "done": done,
                    "terminated": terminated,
                }
                self.log[env].append(row)
                self.obs[env] = self._fresh() if done else row["following"]
                rows.append(row)
            steps.append(rows)

        def column(name, width=1):
            values = torch.tensor([[[row[name]] for row in rows] for rows in steps]).transpose(0, 1)
            return values.expand(*values.shape[:2], width).clone()

        leaves = {
            "actor": column("obs", 2),
            "critic": column("obs", 3),
            "action": column("action"),
            ("next", "actor"): column("following", 2),
            ("next", "critic"): column("following", 3),
            ("next", "reward"): column("reward"),
            ("next", "done"): column("done"),
            ("next", "terminated"): column("terminated"),
        }
        return TensorDict(leaves, batch_size=[NUM_ENVS, length])

    def expected(self, obs, n_step):
        """Return reward, what follows, done, terminated and steps of the env state that observed `obs`."""
        for rows in self.log:
            for start, row in enumerate(rows):
                if row["obs"] == obs:
                    part = rows[start : start + n_step]
                    ends = [step for step, one in enumerate(part) if one["done"]]
                    part = part[: ends[0] + 1] if ends else part
                    reward = sum(GAMMA**step * one["reward"] for step, one in enumerate(part))
                    last = part[-1]
                    return reward, last["following"], last["done"], last["terminated"], len(part)
        raise AssertionError(f"no env state observed {obs}")


def _storage(n_step=1, capacity=CAPACITY):
    return ReplayStorage(
        num_envs=NUM_ENVS,
        capacity=capacity,
        observations=["actor", "critic"],
        n_step=n_step,
        gamma=GAMMA,
    )


def test_a_refusal_names_what_the_whole_replay_takes():
    """Else too many envs seem to fit: of Go1's 535 bytes per env state, the first leaf has 192."""
    storage = _storage(capacity=2**20)
    rollout = _History().rollout(1)
    # Observations of 2^25 numbers without memory of their own: no machine has addresses for a ring of them.
    for name in ("actor", "critic"):
        for key in (name, ("next", name)):
            rollout[key] = torch.zeros(1).expand(NUM_ENVS, 1, 2**25)
    with pytest.raises(RuntimeError) as refused:
        storage.write(rollout)
    assert refused_bytes(refused.value) == storage.max_size * (2 * 2**25 * 4 + 4 + 4 + 1 + 1)


@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("lengths", [(1,), (4, 4), (1,) * 60, (7, 2, 5) * 5])
def test_each_env_state_comes_with_what_followed_it(n_step, lengths):
    history, storage = _History(), _storage(n_step)
    for length in lengths:
        storage.write(history.rollout(length))
    sample = storage.get(torch.arange(len(storage)))
    kept = sample[MASK_KEY].squeeze(-1)
    assert kept.sum() == storage.available.sum()
    seen = set()
    for row in sample[kept]:
        reward, following, done, terminated, steps = history.expected(
            row["actor"][0].item(), n_step
        )
        assert row["next", "reward"].item() == pytest.approx(reward)
        assert (row["next", "actor"] == following).all() and (
            row["next", "critic"] == following
        ).all()
        assert (row["critic"] == row["actor"][0]).all() and row["action"] == -row["actor"][:1]
        assert bool(row["next", "done"]) == done and bool(row["next", "terminated"]) == terminated
        assert row["steps_to_next_obs"].item() == steps
        seen.add(row["actor"][0].item())
    # The newest env states of each env are there, as many as there is room for with their episodes' ends.
    for rows in history.log:
        places = 0
        for row in reversed(rows):
            places += 1 + row["done"]
            if places > CAPACITY:
                break
            assert row["obs"] in seen


def test_sampling_is_uniform_over_what_is_stored_and_makes_no_sync():
    ring = ReplayRing(
        ReplayCfg(
            num_env_states_per_minibatch=4000, num_minibatches=1, num_steps=5, capacity=CAPACITY
        ),
        num_envs=NUM_ENVS,
        observations=["actor", "critic"],
    )
    history = _History(end=0.4)
    for number in range(6):
        ring.extend(history.rollout(5))
        torch.manual_seed(number)
        rollout = history.rollout(5)
        with count_syncs() as syncs:
            ring.extend(rollout)
            minibatch = next(ring.minibatches(1))
        assert syncs.total == 0, syncs.report()
        drawn = minibatch["actor"][minibatch[MASK_KEY].squeeze(-1)][:, 0]
        assert drawn.shape[0] > 0.95 * 4000
        values, counts = drawn.unique(return_counts=True)
        assert values.shape[0] == ring.num_stored
        chi_square = ((counts - counts.float().mean()) ** 2 / counts.float().mean()).sum()
        # Its mean is n - 1 and its variance 2 (n - 1).
        free = values.shape[0] - 1
        assert chi_square < free + 5 * (2 * free) ** 0.5


@pytest.mark.parametrize("leaf", ["actor", ("next", "critic"), "action", ("next", "reward")])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_env_states_that_are_not_finite_are_refused_and_counted(leaf, bad):
    history, storage = _History(end=0.0), _storage(n_step=3)
    rollout = history.rollout(6)
    rollout[leaf][1, 2, 0] = bad
    storage.write(rollout)
    storage.write(history.rollout(2))
    assert int(storage.non_finite_count) == 1
    assert int(storage.available.sum()) == 8 * NUM_ENVS - 1
    sample = storage.get(torch.arange(len(storage)))
    assert all(
        value.isfinite().all() for value in sample.values(True, True) if value.is_floating_point()
    )
    kept = sample[sample[MASK_KEY].squeeze(-1)]
    refused = history.log[1][2]["obs"]
    assert not (kept["actor"][:, 0] == refused).any()
    # Sums of rewards end before it.
    before = kept[kept["actor"][:, 0] == history.log[1][1]["obs"]]
    assert before["steps_to_next_obs"].item() == 1
    assert before["next", "actor"][0, 0] == (0.0 if leaf == "actor" else refused)


def test_a_reset_between_rollouts_does_not_join_two_episodes():
    history, storage = _History(end=0.0), _storage()
    storage.write(history.rollout(3))
    history.obs[1] = history._fresh()
    storage.write(history.rollout(3))
    sample = storage.get(torch.arange(len(storage)))
    kept = sample[sample[MASK_KEY].squeeze(-1)]
    assert kept.shape[0] == 6 * NUM_ENVS - 1
    assert not (kept["actor"][:, 0] == history.log[1][2]["obs"]).any()


def test_writes_keep_the_addresses_and_state_continues_exactly():
    history = _History()
    first, second = _storage(3), _storage(3)
    for _ in range(9):
        first.write(history.rollout(4))
    second.write(history.rollout(1))
    own = {key: leaf.data_ptr() for key, leaf in second.content.items(True, True)}
    second.load_state_dict(
        {k: v.copy() if isinstance(v, dict) else v.clone() for k, v in first.state_dict().items()}
    )
    rollout = history.rollout(4)
    first.write(rollout), second.write(rollout)
    everything = torch.arange(len(first))
    assert (first.get(everything) == second.get(everything)).all()
    assert own == {key: leaf.data_ptr() for key, leaf in second.content.items(True, True)}
    fresh = _storage(3)
    fresh.load_state_dict(first.state_dict())
    assert (first.get(everything) == fresh.get(everything)).all()
    with pytest.raises(ValueError, match="capacity"):
        _storage(3, capacity=30).load_state_dict(first.state_dict())


def test_observations_cost_their_bytes_once():
    storage = _storage()
    storage.write(_History().rollout(2))
    per_place = sum(
        leaf.numel() * leaf.element_size() for leaf in storage.content.values(True, True)
    )
    # Observations 5 floats, action and reward one each, two flags.
    assert per_place / (NUM_ENVS * (CAPACITY + 1)) == 7 * 4 + 2


def test_what_it_refuses():
    history = _History()
    with pytest.raises(ValueError, match="capacity must be at least"):
        _storage(capacity=10).write(history.rollout(6))
    with pytest.raises(ValueError, match="batch_size"):
        _storage().write(history.rollout(6).reshape(-1))
    with pytest.raises(ValueError, match="lacks"):
        _storage().write(history.rollout(2).exclude(("next", "actor")))
    with pytest.raises(ValueError, match="overwrite itself"):
        ReplayCfg(num_env_states_per_minibatch=4, num_minibatches=1, num_steps=8, capacity=16)
    with pytest.raises(ValueError, match="num_steps"):
        ReplayCfg(num_env_states_per_minibatch=4, num_minibatches=1, num_steps=0)
