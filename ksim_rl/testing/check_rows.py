"""Finds rows that do not repeat, that a reset of other rows changes, or whose last observation is lost."""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.testing.replays import (
    Replays,
    copy_of,
    differing,
    end_episodes_at_next_step,
    reset_rows,
    same_bits,
)


def check_determinism(env: EnvBase, num_steps: int) -> None:
    """The same seed and actions give the same EnvStates, bit for bit (on the CPU, where physics is deterministic)."""
    # On a GPU sums of physics may come in another order, so bits may differ without a fault.
    if env.device is not None and env.device.type != "cpu":
        return
    replays = Replays(env, num_steps)
    rows = range(env.batch_size[0])
    # Step by step, so that the first difference is the one that is reported.
    for step, (one, other) in enumerate(zip(replays.run(), replays.run(), strict=True)):
        _refuse(
            differing(one, other, rows),
            f"differ at step {step} between two runs of the same seed and actions. Draw all random numbers from "
            "`view.uniform` and `view.normal` (or another generator that `set_seed` seeds), and keep what changes from "
            "step to step in `view.buffer`, so that `state_dict` has it",
        )


def check_partial_reset(env: EnvBase, num_steps: int) -> None:
    """A reset of row 0 leaves every bit of the other rows as it was: state, clocks, commands, histories, roots."""
    num_envs = env.batch_size[0]
    if num_envs < 2:
        raise AssertionError(
            f"the env has {num_envs} row: build it with at least 2, so that one can stay untouched"
        )
    # Row 0 is reset, all others must not notice.
    others = range(1, num_envs)
    replays = Replays(env, num_steps)
    root = replays.start()
    for index in range(num_steps):
        _, root = replays.step(root, index)
    # `TensorDict.clone` adds zero to tensors on a device, which takes the sign of a negative zero.
    before = _rows_of_state(env)
    root_before = root.apply(torch.clone)
    assert root_before is not None
    root = reset_rows(env, root, [0])
    after = _rows_of_state(env)
    changed = [key for key, value in before.items() if _others_changed(value, after[key], num_envs)]
    advice = (
        "Write through the mask only: `torch.where(mask, new, old)`, or `view.write_*(mask_E, ...)`"
    )
    _refuse(
        changed, f"of the state change in rows that a reset of row 0 should leave alone. {advice}"
    )
    # Keys that only one of the two roots has are not compared.
    kept = root_before.select(*root.keys(True, True), strict=False)
    _refuse(
        differing(kept, root, others),
        f"of the root change in rows that a reset of row 0 should leave alone. {advice}",
    )
    if env.device is not None and env.device.type != "cpu":
        return
    # Later steps, too: a shared generator or counter shows only there.
    undisturbed = replays.run()
    disturbed = replays.run(reset_at=num_steps // 2, rows=[0])
    for step, (one, other) in enumerate(zip(undisturbed, disturbed, strict=True)):
        _refuse(
            differing(one, other, others),
            f"differ at step {step} in rows that were never reset, if row 0 is reset before step {num_steps // 2}. "
            "Rows share something: a generator (draw through the view, which keys draws by row), a counter or a sum",
        )


def check_episode_end(env: EnvBase, num_steps: int) -> None:
    """`next` holds the observation of the state reached, also where the episode ended; roots begin the next episode."""
    replays = Replays(env, num_steps)
    root = replays.start()
    for index in range(num_steps):
        if index == num_steps // 2:
            # Without it a short rollout may have no end at all.
            end_episodes_at_next_step(env)
        env_state_E, root = replays.step(root, index)
        # Without rewards and flags, which differ between `next` and a root anyway.
        observed = set(env.full_observation_spec.keys(True, True))
        next_E = env_state_E.get("next")
        _check_end(next_E, root, [key for key in next_E.keys(True, True) if key in observed])


def _check_end(next_E: TensorDictBase, root: TensorDictBase, keys: list[NestedKey]) -> None:
    ended_E = next_E.get("done").flatten()
    going = (~ended_E).nonzero().flatten().tolist()
    ended = ended_E.nonzero().flatten().tolist()
    next_obs = next_E.select(*keys)
    root_obs = root.select(*keys)
    _refuse(
        differing(next_obs, root_obs, going),
        "differ between `next` and the next root in rows that go on. Compute each observation once per step: noise, "
        "delay and history must not advance again in `_reset`",
    )
    # Equal in all keys means that the state reached was overwritten by the reset.
    for row in ended:
        if keys and len(differing(next_obs, root_obs, [row])) == 0:
            raise AssertionError(
                f"row {row} ended, and its `next` observation is of the new episode. `_step` must return the "
                "observation of the state reached; leave resets to `_reset`, which `maybe_reset` calls with `done`"
            )
    if ended and bool(root.get("done")[ended].any()):
        raise AssertionError(
            f"rows {ended} ended and are still done after their reset. `_reset` must return done=False"
        )


def _others_changed(before: Tensor, after: Tensor, num_envs: int) -> bool:
    """Whether anything but row 0 changed, for each dim that may be the env dim (a ring may have E frames)."""
    dims = [dim for dim, size in enumerate(before.shape) if size == num_envs]
    return all(
        not same_bits(before.narrow(dim, 1, num_envs - 1), after.narrow(dim, 1, num_envs - 1))
        for dim in dims
    )


def _rows_of_state(env: EnvBase) -> dict[str, Tensor]:
    """Return copies of the entries of the state that have one row per env."""
    return {
        key: copy_of(value)
        for key, value in env.state_dict().items()
        if isinstance(value, Tensor) and env.batch_size[0] in value.shape
    }


def _refuse(keys: list[NestedKey] | list[str], message: str) -> None:
    if keys:
        if len(keys) > 5:
            more = f", ... ({len(keys)} in all)"
        else:
            more = ""
        raise AssertionError(f"{', '.join(map(repr, keys[:5]))}{more} {message}")
