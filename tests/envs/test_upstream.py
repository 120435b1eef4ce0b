"""What envs use of TorchRL beyond its documents is still there; a failure names what moved."""

from importlib.metadata import version

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, SerialEnv

from ksim_rl.envs import MaskedTransformedEnv, upstream
from ksim_rl.testing import CounterEnv

TORCHRL = f"TorchRL {version('torchrl')}"


def test_simulators_of_others_cannot_reset_nothing():
    moved = f"{TORCHRL}: _EnvWrapper, BatchedEnvBase or EnvBase._simple_done"
    assert upstream.can_reset_nothing(MaskedTransformedEnv(CounterEnv((3, 4)))), moved
    for env in (GymEnv("Pendulum-v1"), SerialEnv(2, lambda: GymEnv("Pendulum-v1"))):
        assert not upstream.can_reset_nothing(env), moved


def test_resets_refuse_another_batch_size():
    env = CounterEnv((3, 4))
    assert not upstream.resolved_set_state(env, None, None, False), f"{TORCHRL}: _resolve_set_state"
    with pytest.raises(RuntimeError, match="batch"):
        upstream.resolved_set_state(env, TensorDict({}, [4]), None, False)
        pytest.fail(f"{TORCHRL}: _assert_tensordict_shape")


def test_flags_that_a_reset_left_out_are_completed():
    root = TensorDict({"done": torch.ones(3, 1, dtype=torch.bool)}, [3])
    upstream.complete_done(CounterEnv((3, 4, 5)), root)
    assert root["terminated"].all() and root["terminated"].shape == (3, 1), (
        f"{TORCHRL}: _complete_done"
    )


def test_names_are_kept_where_none_is_given():
    moved = f"tensordict {version('tensordict')}: TensorDictBase.refine_names"
    data = TensorDict({}, [2, 3, 4], names=[None, "E", None])
    assert data.refine_names(None, None, "time").names == [None, "E", "time"], moved
    assert data.refine_names(..., "time").names == [None, "E", "time"], moved
    with pytest.raises(RuntimeError, match="cannot coerce"):
        data.refine_names(None, "B", None)
        pytest.fail(moved)


@pytest.mark.parametrize("hook", ["_step_proc_data", "_make_output_spec", "_make_input_spec"])
def test_the_hooks_that_envs_override_are_called(hook, monkeypatch):
    called = []
    original = getattr(MaskedTransformedEnv, hook)
    monkeypatch.setattr(
        MaskedTransformedEnv,
        hook,
        lambda self, *given: called.append(hook) or original(self, *given),
    )
    env = MaskedTransformedEnv(CounterEnv((3, 4)))
    env.rollout(2)
    assert called and env.observation_spec is not None, f"{TORCHRL}: {hook} is not called"
