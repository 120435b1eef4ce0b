import math

import pytest
import torch

from ksim_rl import mdp
from tests.mdp.bench import TWO_WHEELS


def test_time_runs_with_env_steps(make_bench):
    bench = make_bench(TWO_WHEELS, 2, max_episode_length=50)
    bench.view.episode_step_E.copy_(torch.tensor([0, 7]))
    torch.testing.assert_close(bench.read(mdp.EpisodeTime()), torch.tensor([[0.0], [0.14]]))
    # 50 steps of 20 ms; the second env's first episode is cut 3 steps early.
    bench.view.time_out_offset_E.copy_(torch.tensor([0, 3]))
    torch.testing.assert_close(bench.read(mdp.RemainingTime()), torch.tensor([[1.0], [0.8]]))


def test_remaining_time_needs_an_end(free_body):
    with pytest.raises(ValueError, match="episode_length_s=0"):
        free_body.read(mdp.RemainingTime())


def test_clock_turns_at_its_frequency(free_body):
    # At 2.5 Hz a quarter turn takes 0.1 s, five env steps.
    clock = mdp.Clock(frequency=2.5, phases=(0.0, 0.5))
    free_body.view.episode_step_E.copy_(torch.tensor([0, 5, 10]))
    expected = torch.tensor([[0.0, 0.0, 1.0, -1.0], [1.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0]])
    torch.testing.assert_close(free_body.read(clock), expected, atol=1e-6, rtol=0)
    assert free_body.read(mdp.Clock(frequency=2.5)).shape == (3, 2)


@pytest.mark.parametrize(
    "fields", [{"frequency": 0.0}, {"frequency": 1.0, "phases": ()}, {"frequency": math.inf}]
)
def test_clock_refuses_what_does_not_turn(fields):
    with pytest.raises(ValueError, match="frequency|phases"):
        mdp.Clock(**fields)
