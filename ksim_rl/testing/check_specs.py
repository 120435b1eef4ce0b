"""Finds wrong specs, dim names and values, and wrong actions that an env takes."""

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.data import Composite
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.envs.utils import check_env_specs

from ksim_rl import dims
from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.envs.specs import misfit

_NOT_FINITE = "Look for a division by zero, a root of a negative number or an uninitialized buffer where it is computed"


def assert_dims(td: TensorDictBase, *names: str) -> None:
    """Check that the batch dims of `td`, and of each tensordict inside, bear `names`, such as "E", "T"."""
    inside = (
        (f"[{key!r}]", node) for key, node in td.items(True) if isinstance(node, TensorDictBase)
    )
    for where, node in (("", td), *inside):
        assert node.names[: len(names)] == [*names], (
            f"the tensordict{where} has dims {node.names} (batch size {tuple(node.batch_size)}): expected {[*names]}"
        )
    assert td.batch_dims == len(names), (
        f"the tensordict has dims {td.names}: expected exactly {[*names]}"
    )


def assert_leaf(td: TensorDictBase, key: str | tuple[str, ...], *leaf_shape: int) -> None:
    """Check the shape of a leaf beyond the batch dims: `assert_leaf(rollout_ET, "actor", 48)` for [E, T, 48].

    A picture has several: `assert_leaf(rollout_ET, "rgb", 64, 64, 3)` for H, W, C.
    """
    found = tuple(td[key].shape[td.batch_dims :])
    assert found == leaf_shape, (
        f"{key!r} has shape {found} beyond {td.names}: expected {leaf_shape}"
    )


SPECS = ("full_observation_spec", "full_action_spec", "full_reward_spec", "full_done_spec")


def check_names(env: EnvBase, num_steps: int) -> None:
    """Specs and data carry the label "E", rollouts ("E", "T"); TorchRL's own check looks at no names."""
    for which in SPECS:
        _check_spec_names(getattr(env, which), which, env.batch_dims)
    root = env.reset()
    # Each way in which an env returns data is looked at, as labels get lost in each on its own.
    assert_dims(root, dims.E)
    stepped = env.step(env.rand_action(root))
    assert_dims(stepped["next"], dims.E)
    _, root = env.step_and_maybe_reset(env.rand_action(env.reset()))
    assert_dims(root, dims.E)
    assert_dims(env.rollout(num_steps, break_when_any_done=False), dims.E, dims.T)


def check_values(env: EnvBase, num_steps: int) -> None:
    """Observations have the shapes and dtypes of their specs and are inside them; these, and rewards, are finite."""
    _check_values(env.reset(), env, "reset")
    rollout_ET = env.rollout(num_steps, break_when_any_done=False)
    # Step by step, so that the error can say when.
    for step in range(num_steps):
        _check_values(rollout_ET[:, step]["next"], env, f"step {step}")
    base_env = part(env, ManagerBasedRlEnv)
    # Terms first: the name of a term says more than the name of a group.
    if base_env is None:
        lines = []
    else:
        lines = base_env.non_finite_terms()
    if lines:
        raise AssertionError(f"{'; '.join(lines)}. {_NOT_FINITE}")
    reward = rollout_ET["next", "reward"]
    if not bool(torch.isfinite(reward).all()):
        raise AssertionError(f"the reward is not finite. {_NOT_FINITE}")


def check_torchrl(env: EnvBase, num_steps: int) -> None:
    """The demands of TorchRL's own `check_env_specs`."""
    check_env_specs(env)


def check_actions(env: EnvBase, num_steps: int) -> None:
    """Actions of a wrong shape or dtype are refused."""
    action = env.rand_action(env.reset())[env.action_key]
    # Each would broadcast or convert in silence.
    wrong = {
        "one element more": torch.cat((action, action[..., :1]), dim=-1),
        "no leaf dim": action[..., 0],
        "dtype float64": action.double() if action.dtype != torch.float64 else action.float(),
    }
    # From a new root each time, since a refused step may have changed it.
    for what, bad in wrong.items():
        td = env.reset()
        try:
            env.step(td.set(env.action_key, bad))
        except (ValueError, RuntimeError, TypeError):
            continue
        raise AssertionError(
            f"step accepted an action with {what}: {tuple(bad.shape)} {bad.dtype} "
            f"for {tuple(action.shape)} {action.dtype}. Compare shape and dtype with the spec in `_step`: a wrong "
            "shape broadcasts silently"
        )
    env.reset()


def _check_spec_names(spec: Composite, where: str, batch_dims: int) -> None:
    if spec.ndim == batch_dims and spec.names != [dims.E]:
        raise AssertionError(
            f"{where} has the names {spec.names}: expected ['{dims.E}']. "
            f"Set `spec.names = ['{dims.E}']` where it is made"
        )
    # Nested composites have names of their own.
    for key, child in spec.items():
        if isinstance(child, Composite):
            _check_spec_names(child, f"{where}[{key!r}]", batch_dims)


def _check_values(tensordict: TensorDictBase, env: EnvBase, when: str) -> None:
    spec = env.full_observation_spec
    for key in spec.keys(True, True):
        value = tensordict.get(key, None)
        if value is None:  # `check_env_specs` lists keys that are missing or too many
            continue
        if reason := misfit(value, spec[key]):
            raise AssertionError(
                f"observation {key!r}, {_written_by(env, key)}, {reason} (at {when})"
            )
        # Before the range, as NaN is outside of every range, too.
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            rows = (
                (~torch.isfinite(value.reshape(value.shape[0], -1)).all(-1))
                .nonzero()
                .flatten()
                .tolist()
            )
            where = f"at {when}, in the rows {rows}, {_written_by(env, key)}"
            raise AssertionError(f"observation {key!r} is not finite {where}. {_NOT_FINITE}")
        if not spec[key].is_in(value):
            raise AssertionError(
                f"observation {key!r} leaves its spec at {when}: values {value.min()} to {value.max()}, {spec[key]}. "
                "Widen the spec, or clip the value"
            )


def _written_by(env: EnvBase, key: NestedKey) -> str:
    """Return which transform wrote an observation last, or that the env did."""
    # From the outermost wrapper inwards; within one wrapper the last transform counts.
    found = "written by the env"
    # The outermost wrapper writes last.
    while isinstance(env, TransformedEnv):
        if isinstance(env.transform, Compose):
            transforms = env.transform
        else:
            transforms = [env.transform]
        for number, transform in enumerate(transforms):
            if unravel_key(key) in [unravel_key(own) for own in transform.out_keys or ()]:
                found = f"written by transform {number}, {type(transform).__name__}"
        if found != "written by the env":
            break
        env = env.base_env
    return found
