"""Evaluations against envs and policies whose returns are known in closed form."""

import pytest
import torch
from tensordict.nn import TensorDictModule

from ksim_rl.trainers import Evaluator
from tests.trainers.target_env import LENGTH, make_env, make_trainer


def policy(function):
    return TensorDictModule(function, in_keys=["actor"], out_keys=["action"])


def exact(actor):
    return actor.clone()


def off_by_half(actor):
    return actor + 0.5


def evaluator(function, *, max_steps=LENGTH, **env):
    return Evaluator(make_env(5, **env), policy(function), max_steps=max_steps, seed=3)


def test_the_return_is_the_sum_over_one_episode_of_each_env():
    result = evaluator(off_by_half)()
    assert result.return_mean == pytest.approx(LENGTH * 0.75)
    assert result.return_std == pytest.approx(0.0, abs=1e-6)
    assert (result.length_mean, result.episodes, result.unfinished) == (LENGTH, 5, 0)


def test_only_the_first_episode_counts():
    result = evaluator(exact, max_steps=3 * LENGTH)()
    assert result.return_mean == pytest.approx(LENGTH)
    assert result.length_mean == LENGTH


def test_an_episode_ends_at_a_termination():
    result = evaluator(exact, terminate_at=3)()
    assert (result.return_mean, result.length_mean) == (pytest.approx(3.0), 3.0)


@pytest.mark.parametrize(("terminate_at", "terminated"), [(3, True), (None, False)])
def test_terminations_are_told_from_other_ends(terminate_at, terminated):
    evaluate = evaluator(exact, max_steps=2 * LENGTH, terminate_at=terminate_at)
    evaluate()
    assert evaluate.terminated_E.tolist() == [terminated] * 5


def test_episodes_beyond_the_step_limit_are_counted_as_unfinished():
    result = evaluator(exact, max_steps=5)()
    assert (result.length_mean, result.unfinished) == (5.0, 5)


def test_repeating_an_evaluation_gives_the_same_figures():
    evaluate = evaluator(lambda actor: torch.zeros_like(actor))
    first = evaluate()
    assert evaluate() == first
    assert first.return_std > 0.0


def test_the_actor_acts_deterministically():
    trainer = make_trainer()
    assert trainer.evaluator() == trainer.evaluator()


def test_sensor_noise_is_off_in_an_env_in_eval_mode():
    noisy = evaluator(exact, noise=0.5)
    assert noisy().return_mean < LENGTH - 0.5
    noisy.env.eval()
    assert noisy().return_mean == pytest.approx(LENGTH)


def test_an_evaluation_can_be_stopped_between_steps():
    asked = []

    def stop():
        asked.append(1)
        return len(asked) > 3

    assert evaluator(exact)(stop=stop) is None
    assert len(asked) == 4
