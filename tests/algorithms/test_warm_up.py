"""A warm-up compiles and captures the work of an update before the first env step, and leaves no trace."""

import pytest

from ksim_rl.device import state_tree
from tests.algorithms import imitation_problems, off_policy_problem
from tests.trainers.target_env import make_trainer

OF_THE_CLOCK = ("seconds", "throughput/env_states_per_s", "warm_up_s")
PROBLEMS = {
    "ppo": make_trainer,
    "sac": lambda: off_policy_problem.make_trainer("sac"),
    "fast_td3": lambda: off_policy_problem.make_trainer("fast_td3", data={"prioritized": True}),
    "replay_not_saved": lambda: off_policy_problem.make_trainer("td3", data={"save_replay": False}),
    "bc": imitation_problems.make_bc,
    "amp": imitation_problems.make_amp,
    "distillation": imitation_problems.make_distillation,
}


def state_of(trainer):
    tensors, values = state_tree.split(trainer.state_dict())
    values.pop("/seconds")
    return tensors, values


def numbers_after(trainer, iterations):
    """Return the state after some iterations, and the metrics on the way there."""
    logged = []
    for _ in range(iterations):
        trainer.iterate()
        trainer.settle()
        logged.append(
            {
                name: trainer.metrics[name]
                for name in sorted(trainer.metrics)
                if name not in OF_THE_CLOCK
            }
        )
    return state_of(trainer), logged


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_run_has_the_same_numbers_with_and_without(name):
    warm = PROBLEMS[name]()  # which seeds torch's generator
    warm.update.warm_up(warm.collector.made_up_rollout())
    (tensors, values), logged = numbers_after(warm, 4)
    (expected, expected_values), expected_logged = numbers_after(PROBLEMS[name](), 4)
    assert values == expected_values
    assert tensors.keys() == expected.keys()
    for name, tensor in tensors.items():
        assert tensor.equal(expected[name]), name
    assert repr(logged) == repr(expected_logged)  # NaN is NaN here
