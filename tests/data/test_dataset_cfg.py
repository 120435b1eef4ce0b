import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ksim_rl.data import DatasetCfg, rollout_length


def test_rollout_length_is_dataset_over_envs():
    assert rollout_length(24576, 4, 4096) == 24
    assert rollout_length(24576, 4, 1) == 98304
    cfg = DatasetCfg(num_env_states_per_minibatch=512, num_minibatches=8)
    assert cfg.num_env_states == 4096
    assert cfg.rollout_length(256) == 16


def test_num_envs_does_not_change_the_dataset():
    cfg = DatasetCfg(num_env_states_per_minibatch=1024, num_minibatches=4)
    assert {cfg.rollout_length(num_envs) * num_envs for num_envs in (64, 256, 1024, 4096)} == {4096}


def test_refusal_has_the_three_numbers_and_working_values():
    with pytest.raises(ValueError) as error:
        rollout_length(1000, 4, 768)
    message = str(error.value)
    for text in ("num_env_states_per_minibatch=1000", "num_minibatches=4", "num_envs=768", "4000"):
        assert text in message


def _suggestions(message, field):
    return [
        int(number) for number in re.findall(rf"{field}=(\d+)(?: or (\d+))?", message)[-1] if number
    ]


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 3000), st.integers(1, 40), st.integers(1, 3000))
def test_every_suggested_value_works_and_is_the_nearest(per_minibatch, minibatches, envs):
    try:
        assert (
            rollout_length(per_minibatch, minibatches, envs) * envs == per_minibatch * minibatches
        )
        return
    except ValueError as error:
        message = str(error)
    suggested = {
        "num_env_states_per_minibatch": (per_minibatch, lambda n: (n, minibatches, envs)),
        "num_minibatches": (minibatches, lambda n: (per_minibatch, n, envs)),
        "num_envs": (envs, lambda n: (per_minibatch, minibatches, n)),
    }
    for field, (value, arguments) in suggested.items():
        numbers = _suggestions(message.split("Change one of them")[1], field)
        assert numbers, message
        for number in numbers:
            rollout_length(*arguments(number))
        between = range(min([value, *numbers]) + 1, max([value, *numbers]))
        for number in (n for n in between if n not in numbers):
            with pytest.raises(ValueError, match="cannot be shared"):
                rollout_length(*arguments(number))


@pytest.mark.parametrize("value", [0, -1, 2.0, True, "8"])
@pytest.mark.parametrize("field", ["num_env_states_per_minibatch", "num_minibatches"])
def test_config_refuses_what_is_no_count(field, value):
    with pytest.raises(ValueError, match=f"{field}="):
        DatasetCfg(**({"num_env_states_per_minibatch": 8, "num_minibatches": 2} | {field: value}))


def test_num_envs_must_be_a_count():
    with pytest.raises(ValueError, match="num_envs=0"):
        rollout_length(8, 2, 0)
