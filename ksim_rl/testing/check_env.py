"""The checks that every env has to pass, ours and yours."""

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from ksim_rl import dims
from ksim_rl.testing.dims import assert_dims


def check_env(env: EnvBase, *, num_steps: int = 3, check_actions: bool = True) -> None:
    """Check an env with batch size [E] against TorchRL's contract and ours; the env's seed and state change.

    TorchRL's `check_env_specs` (which looks at neither names nor values), the label "E" on specs and data, ("E", "T")
    on rollouts, finite observations inside their specs, and the refusal of actions of a wrong shape or dtype.

    Args:
        num_steps: length of the rollout that is looked at.
        check_actions: False skips the refusal of actions.

    Raises:
        AssertionError: naming what is wrong.
    """
    specs = ("full_observation_spec", "full_action_spec", "full_reward_spec", "full_done_spec")
    for which in specs:
        _check_spec_names(getattr(env, which), which, env.batch_dims)
    root = env.reset()
    assert_dims(root, dims.E)
    _check_values(root, env.full_observation_spec, "reset")
    stepped = env.step(env.rand_action(root))
    assert_dims(stepped["next"], dims.E)
    _, root = env.step_and_maybe_reset(env.rand_action(env.reset()))
    assert_dims(root, dims.E)
    rollout_ET = env.rollout(num_steps, break_when_any_done=False)
    assert_dims(rollout_ET, dims.E, dims.T)
    for step in range(num_steps):
        _check_values(rollout_ET[:, step]["next"], env.full_observation_spec, f"step {step}")
    check_env_specs(env)
    if check_actions:
        _check_action_refusal(env)


def _check_spec_names(spec: Composite, where: str, batch_dims: int) -> None:
    if spec.ndim == batch_dims and spec.names != [dims.E]:
        raise AssertionError(f"{where} has the names {spec.names}: expected ['{dims.E}']")
    for key, child in spec.items():
        if isinstance(child, Composite):
            _check_spec_names(child, f"{where}[{key!r}]", batch_dims)


def _check_values(tensordict: TensorDictBase, spec: Composite, when: str) -> None:
    for key in spec.keys(True, True):
        value = tensordict.get(key, None)
        if value is None:  # `check_env_specs` lists what is missing and what is too much
            continue
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            rows = (~torch.isfinite(value.reshape(value.shape[0], -1)).all(-1)).nonzero().flatten().tolist()
            raise AssertionError(f"observation {key!r} is not finite at {when}, in the rows {rows}")
        if not spec[key].is_in(value):
            raise AssertionError(
                f"observation {key!r} leaves its spec at {when}: values {value.min()} to {value.max()}, {spec[key]}"
            )


def _check_action_refusal(env: EnvBase) -> None:
    action = env.rand_action(env.reset())[env.action_key]
    wrong = {
        "one element more": torch.cat((action, action[..., :1]), dim=-1),
        "no leaf dim": action[..., 0],
        "dtype float64": action.double() if action.dtype != torch.float64 else action.float(),
    }
    for what, bad in wrong.items():
        td = env.reset()
        try:
            env.step(td.set(env.action_key, bad))
        except (ValueError, RuntimeError, TypeError):
            continue
        raise AssertionError(
            f"step accepted an action with {what}: {tuple(bad.shape)} {bad.dtype} "
            f"for {tuple(action.shape)} {action.dtype}"
        )
    env.reset()
