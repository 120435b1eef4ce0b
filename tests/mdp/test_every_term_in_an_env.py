"""All observations and rewards together in one env: no host sync, no mixing of rows, no second advance of a filter."""

import pytest
import torch

from ksim_rl import mdp
from ksim_rl.envs.term import ObservationTerm, RewardTerm
from ksim_rl.testing import count_syncs
from tests.mdp.every_term_env import OBSERVATIONS, REWARDS, actions, every_term_env


@pytest.fixture(scope="module")
def env():
    return every_term_env()


# They need other scenes: cameras, terrains, an IMU.
OF_OTHER_SCENES = {
    mdp.CameraImage,
    mdp.ContactReading,
    mdp.HeightScan,
    mdp.ImuReading,
    mdp.RayDistance,
    mdp.RayHeight,
}


def test_no_term_is_left_out():
    """Terms in modules with at least one such term; others need reference motions."""
    used = {type(term) for term in (*OBSERVATIONS.values(), *REWARDS.values())}
    modules = {term.__module__ for term in used}
    library = [getattr(mdp, name) for name in mdp.__all__]
    assert used | OF_OTHER_SCENES == {
        term
        for term in library
        if issubclass(term, (ObservationTerm, RewardTerm)) and term.__module__ in modules
    }


def test_steps_and_resets_never_make_the_host_wait(env):
    chosen, root_E = actions(20, env), env.reset()
    ended = torch.zeros(3, dtype=torch.bool)
    with count_syncs() as syncs:
        for step in range(20):
            step_E, root_E = env.step_and_maybe_reset(root_E.set("action", chosen[step]))
            ended |= step_E["next", "done"][:, 0]
    assert syncs.total == 0, syncs.report()
    assert ended.all(), "each env was reset on the way"


def test_rows_that_go_on_keep_their_readings_when_others_reset(env):
    chosen, root_E = actions(20, env), env.reset()
    mixed = 0
    for step in range(20):
        step_E, root_E = env.step_and_maybe_reset(root_E.set("action", chosen[step]))
        after_E, done_E = step_E["next"], step_E["next", "done"][:, 0]
        mixed += int(done_E.any() and not done_E.all())
        for name in OBSERVATIONS:
            reading = after_E["obs", name]
            assert torch.isfinite(reading).all(), name
            assert torch.equal(root_E["obs", name][~done_E], reading[~done_E]), name
    assert mixed > 2


def test_rewards_are_finite_and_each_has_an_effect(env):
    chosen, root_E = actions(40, env), env.reset()
    sums = torch.zeros(len(REWARDS))
    for step in range(40):
        before = env.reward_manager.episode_sums_ER.clone()
        step_E = env.step(root_E.set("action", chosen[step]))
        sums += (env.reward_manager.episode_sums_ER - before).abs().sum(0)
        root_E = env.maybe_reset(step_E["next"].exclude("reward"))
    assert torch.isfinite(sums).all()
    silent = {
        name
        for name, total in zip(env.reward_manager.names, sums.tolist(), strict=True)
        if total == 0.0
    }
    # The robot's limbs cannot touch each other, and its joints have no limits.
    assert silent <= {"SelfCollision", "JointPosLimits"}
