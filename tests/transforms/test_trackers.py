"""Returns, lengths, outcomes and clocks of episodes."""

import pytest
import torch
from torchrl.data import Composite, Unbounded
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.transforms import Compose, RewardSum, StepCounter

from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import EpisodeTracker, SuccessTracker, TimeAwareObservation
from tests.transforms.chains import counter, fixed_rollout

LENGTHS = (3, 5, 4, 7)


def test_returns_and_lengths_equal_torchrls():
    env = counter(EpisodeTracker(), RewardSum(), StepCounter(), lengths=LENGTHS, stock=True)
    rollout_ET = fixed_rollout(env, 20)
    for at in ((), ("next",)):
        assert torch.equal(rollout_ET[(*at, "episode_return")], rollout_ET[(*at, "episode_reward")])
        assert torch.equal(rollout_ET[(*at, "episode_length")], rollout_ET[(*at, "step_count")])


def test_a_row_that_is_done_shows_its_whole_episode():
    rollout_ET = fixed_rollout(counter(EpisodeTracker(), lengths=LENGTHS), 20)
    for row, length in enumerate(LENGTHS):
        ended = rollout_ET["next", "done"][row, :, 0].nonzero()[:, 0].tolist()
        for step in ended:
            reached = rollout_ET["next"][row, step]
            expected = (
                rollout_ET["next", "reward"][row, step + 1 - length : step + 1].double().sum()
            )
            assert reached["episode_length"].item() == length
            assert reached["episode_return"].item() == pytest.approx(expected.item(), abs=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int32])
@pytest.mark.parametrize("size", [1, 2])
def test_rewards_of_any_kind_equal_torchrls(dtype, size):
    """One float32 reward per env has a kernel of its own, all others take torch's operators."""

    class Paid(CounterEnv):
        def __init__(self):
            super().__init__(LENGTHS)
            self.full_reward_spec = Composite(
                reward=Unbounded(torch.Size([len(LENGTHS), size]), dtype=dtype),
                shape=(len(LENGTHS),),
            )

        def _step(self, tensordict):
            reached = super()._step(tensordict)
            reward = (reached["reward"] * 8).round().expand(-1, size) * torch.arange(1, size + 1)
            return reached.set("reward", reward.to(dtype))

    env = TransformedEnv(Paid(), Compose(EpisodeTracker(), RewardSum(), StepCounter()))
    next_ET = fixed_rollout(env, 20)["next"]
    assert next_ET["episode_return"].dtype == dtype
    assert torch.equal(next_ET["episode_return"], next_ET["episode_reward"])
    assert torch.equal(next_ET["episode_length"], next_ET["step_count"])


def test_several_rewards_and_no_length():
    env = counter(EpisodeTracker(["reward"], [("sums", "reward")], length_key=None))
    assert "episode_length" not in env.reset()
    assert env.rollout(2)["next", "sums", "reward"].shape == (3, 2, 1)


@pytest.mark.parametrize(
    ("reduce", "outcomes"), [("any", [False, True, True]), ("last", [False, True, False])]
)
def test_success(reduce, outcomes):
    """Rows reach the counts 3, 4 and 5, and only the count 4 is a success."""

    class Goal(CounterEnv):
        def _observe(self):
            observed = super()._observe()
            return observed | {"row": (observed["count"] == 4).float()}

    env = TransformedEnv(Goal((3, 4, 5)), SuccessTracker("row", reduce=reduce))
    rollout_ET = fixed_rollout(env, 15)
    assert not rollout_ET["episode_success"][:, 0].any()
    for row, outcome in enumerate(outcomes):
        ended = rollout_ET["next", "done"][row, :, 0]
        assert rollout_ET["next", "episode_success"][row, ended].flatten().tolist() == [
            outcome
        ] * int(ended.sum())


def test_success_by_a_done_flag():
    rollout_ET = fixed_rollout(counter(SuccessTracker("terminated")), 15)
    done = rollout_ET["next", "done"]
    assert torch.equal(rollout_ET["next", "episode_success"], rollout_ET["next", "terminated"])
    assert bool((rollout_ET["next", "episode_success"] != done).any())


@pytest.mark.parametrize("normalize", [True, False])
def test_remaining_time(normalize):
    env = counter(TimeAwareObservation(horizon=4, normalize=normalize), lengths=LENGTHS)
    rollout_ET = fixed_rollout(env, 20)
    scale = 4 if normalize else 1
    for at in ((), ("next",)):
        expected = (4 - rollout_ET[(*at, "count")]).clamp_min(0) / scale
        assert torch.equal(rollout_ET[(*at, "remaining_time")], expected)
    assert env.observation_spec["remaining_time"].space.high[0] == 4 / scale


def test_the_horizon_of_the_env():
    env = TransformedEnv(GymEnv("Pendulum-v1"), TimeAwareObservation())
    rollout_T = env.rollout(300)
    assert rollout_T.shape == (200,)
    assert rollout_T["remaining_time"][0] == 1
    assert rollout_T["next", "remaining_time"][-1] == 0
    assert rollout_T["remaining_time"][50] == 0.75


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda: TimeAwareObservation(horizon=0), ValueError, "horizon=0"),
        (lambda: TimeAwareObservation(["a", "b"]), ValueError, "one key"),
        (lambda: counter(TimeAwareObservation()).reset(), ValueError, "never time out"),
        (lambda: SuccessTracker("a", reduce="all"), ValueError, "reduce"),
        (lambda: counter(SuccessTracker("cuont")).reset(), KeyError, "did you mean 'count'"),
        (lambda: EpisodeTracker(["a", "b"]), ValueError, "1 keys for the 2"),
        (lambda: EpisodeTracker(length_key="episode_return"), ValueError, "repeat"),
        (lambda: counter(EpisodeTracker("rewrad")).reset(), KeyError, "did you mean 'reward'"),
    ],
)
def test_wrong_values_are_refused(build, error, message):
    with pytest.raises(error, match=message):
        build()
