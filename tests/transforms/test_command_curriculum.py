import pytest
import torch

from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import RandomCommandCurriculum

START, END = [(0.0, 0.5), (1.0, 1.0)], [(-1.0, 2.0), (0.0, 3.0)]


def run(env, action, num_steps):
    """Let row e get the reward `action[e]` at each step."""
    value = torch.tensor(action)[:, None].expand(-1, 2) / 2
    return env.rollout(num_steps, lambda td: td.set("action", value.clone()), break_when_any_done=False)


def curriculum(lengths=(3, 5, 4, 4), **kwargs):
    transform = RandomCommandCurriculum(
        start=START, end=END, raise_above=0.5, lower_below=-0.5, step=0.25, **kwargs
    )
    env = MaskedTransformedEnv(CounterEnv(lengths), [transform])
    env.set_seed(3)
    return env


def test_levels_follow_the_mean_score_of_whole_episodes():
    env = curriculum(initial_level=0.5)
    rollout_ET = run(env, [1.0, 1.0, -1.0, 0.0], 21)
    # Row 0 ends after 3, 6, ... steps; it rises to 1 and stays there. Row 2 falls to 0, row 3 stays.
    level = rollout_ET["command_level"][..., 0]
    assert level[0].tolist() == [0.5] * 3 + [0.75] * 3 + [1.0] * 15
    assert level[1].tolist() == [0.5] * 5 + [0.75] * 5 + [1.0] * 11
    assert level[2].tolist() == [0.5] * 4 + [0.25] * 4 + [0.0] * 13
    assert level[3].tolist() == [0.5] * 21


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_commands_fill_the_ranges_of_the_level(level):
    env = curriculum(lengths=(5,) * 4000, initial_level=level)
    command = env.reset()["command"]
    for column, (start, end) in enumerate(zip(START, END, strict=True)):
        low, high = (a + level * (b - a) for a, b in zip(start, end, strict=True))
        drawn = command[:, column]
        assert bool((drawn >= low - 1e-6).all()) and bool((drawn <= high + 1e-6).all())
        # Mean and standard deviation of the uniform distribution, within 4 sigma.
        std = (high - low) / 12**0.5
        assert abs(float(drawn.mean()) - (low + high) / 2) <= 4 * std / 4000**0.5 + 1e-6
        assert float(drawn.max() - drawn.min()) >= 0.99 * (high - low)


def test_a_command_holds_until_it_is_due():
    steps = run(curriculum(lengths=(50, 50, 50), resample_every=4), [0.0] * 3, 16)["next", "command"]
    changed = (steps[:, 1:] != steps[:, :-1]).any(-1)
    assert changed.all(0).tolist() == [step % 4 == 2 for step in range(15)]
    assert not changed[:, [step for step in range(15) if step % 4 != 2]].any()
    held = run(curriculum(lengths=(50, 50, 50)), [0.0] * 3, 16)["command"]
    assert bool((held == held[:, :1]).all())


def test_levels_driven_from_outside():
    env = MaskedTransformedEnv(
        CounterEnv((3, 5, 4)), [RandomCommandCurriculum([], start=[(0.0, 0.0)], end=[(1.0, 1.0)])]
    )
    transform = env.transform[0]
    with pytest.raises(RuntimeError, match="levels"):
        transform.set_level_(0.5)
    assert bool((env.reset()["command"] == 0).all())
    transform.set_level_(0.75)
    assert bool((env.reset()["command"] == 0.75).all())
    transform.set_level_(torch.tensor([0.0, 0.5, 2.0]))
    assert env.reset()["command"].flatten().tolist() == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"start": [(0.0, 1.0)]}, "start has 1 ranges and end 2"),
        ({"end": [(0.0, 1.0), (1.0, 0.0)]}, r"end\[1\]"),
        ({"step": 0.0}, "step=0.0"),
        ({"initial_level": 2.0}, "initial_level=2.0"),
        ({"raise_above": 0.0, "lower_below": 1.0}, "exceeds"),
        ({"in_keys": [], "raise_above": 0.0}, "need a score"),
        ({"out_keys": ["a"]}, "two distinct"),
        ({"resample_every": -1}, "resample_every=-1"),
    ],
)
def test_wrong_values_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        RandomCommandCurriculum(**{"start": START, "end": END} | wrong)
