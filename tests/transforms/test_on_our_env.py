"""Transforms on the env of this library: the puck of `probe_env`, whose episodes end by time or by place."""

import pytest
import torch

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import check_env, count_syncs
from ksim_rl.transforms import (
    ActionLowPass,
    EpisodeTracker,
    Mirror,
    MirrorMap,
    ObservationNormalization,
    RewardScale,
    SuccessTracker,
    TimeAwareObservation,
)
from tests.envs.probe_env import DT, puck_env

TURN = MirrorMap(source=(0,), signs=(-1.0,))


@pytest.fixture(scope="module")
def env():
    # Rows 0 to 3 with velocities of 1 to 4 m/s: the later ones leave at 0.5 m, the first ones time out.
    base = puck_env(num_envs=4, limit=0.5, episode_length_s=10 * DT)
    position = ("obs", "position")
    return MaskedTransformedEnv(
        base,
        [
            TimeAwareObservation(),
            EpisodeTracker(),
            SuccessTracker("terminated"),
            ObservationNormalization(("obs", "velocity"), "normalized"),
            Mirror(position, "seen", maps={position: TURN, "action": TURN}),
            RewardScale("reward", "scaled", scale=2.0),
            ActionLowPass(alpha=0.5, initial=0.0),
        ],
    )


def test_all_checks(env):
    # The rows of an env share the statistics of normalization.
    check_env(env, num_steps=6, skip=("memory", "partial_reset", "c_engine"))


def test_trackers_agree_with_the_envs_own_log(env):
    base = env.base_env
    env.reset(seed=1)
    base.episode_log_reset_()
    with count_syncs() as syncs:
        root = env.reset()
        for _ in range(3):
            _, root = env.step_and_maybe_reset(root.set("action", torch.zeros(4, 1)))
    assert syncs.total == 0, syncs.report()
    env.reset(seed=1)
    base.episode_log_reset_()
    rollout_ET = env.rollout(
        25, lambda td: td.set("action", torch.zeros(4, 1)), break_when_any_done=False
    )
    next_ET, done = rollout_ET["next"], rollout_ET["next", "done"]
    log = base.episode_log()
    assert int(log["episodes"]) == int(done.sum()) > 4
    assert int(log["length_sum"]) == int(next_ET["episode_length"][done].sum())
    torch.testing.assert_close(log["return_sum"], next_ET["episode_return"][done].sum())
    assert int(log["termination/beyond"]) == int(next_ET["episode_success"][done].sum())
    assert torch.equal(next_ET["scaled"], 2 * next_ET["reward"])
    # The clock runs out where the env's own one does.
    assert torch.equal(
        next_ET["remaining_time"][next_ET["truncated"]],
        torch.zeros(int(next_ET["truncated"].sum())),
    )
    assert bool((next_ET["remaining_time"][next_ET["terminated"]] > 0).all())
