"""Replays the same actions from the same start, as often as a check needs them."""

from collections.abc import Sequence

import torch
from jaxtyping import Shaped
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.utils._pytree import PyTree
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv

SEED = 11


class Replays:
    """Remembers an env's state; each replay starts there, with the same seed and the same random actions.

    The level of a curriculum outlives a seed, so a seed does not restore the start on its own.
    """

    def __init__(self, env: EnvBase, num_steps: int) -> None:
        self.env = env
        self.num_steps = num_steps
        # Some transforms' states begin with the first reset.
        env.reset()
        self._state = {key: copy_of(value) for key, value in env.state_dict().items()}
        # `rand_action` draws from torch's global generator.
        torch.manual_seed(SEED)
        root = env.reset()
        self._actions = [env.rand_action(root)[env.action_key].clone() for _ in range(num_steps)]

    def start(self) -> TensorDictBase:
        """Return to the start, and return its root."""
        self.env.load_state_dict({key: copy_of(value) for key, value in self._state.items()})
        # After the state, which has a seed of its own.
        self.env.set_seed(SEED)
        return self.env.reset()

    def step(self, root: TensorDictBase, index: int) -> tuple[TensorDictBase, TensorDictBase]:
        """Step with the action of this index, and reset the envs that ended."""
        return self.env.step_and_maybe_reset(root.set(self.env.action_key, self._actions[index]))

    def run(self, *, reset_at: int = -1, rows: Sequence[int] = ()) -> list[TensorDictBase]:
        """Run all steps, and return a copy of each EnvState; `rows` are reset before step `reset_at`."""
        root = self.start()
        env_states = []
        for index in range(self.num_steps):
            if index == reset_at:
                root = reset_rows(self.env, root, rows)
            env_state_E, root = self.step(root, index)
            # The env may write the next step into the same memory.
            env_states.append(env_state_E.clone())
        return env_states


def reset_rows(env: EnvBase, root: TensorDictBase, rows: Sequence[int]) -> TensorDictBase:
    """Reset some rows only, by the mask that TorchRL knows."""
    # In the shape of `done`, [E, 1].
    mask = torch.zeros_like(root.get("done"))
    mask[list(rows)] = True
    return env.reset(root.set("_reset", mask))


def end_episodes_at_next_step(env: EnvBase) -> None:
    """Let the episodes of a `ManagerBasedRlEnv` with a time limit end at the next step; other envs do not change."""
    base_env = part(env, ManagerBasedRlEnv)
    if base_env is not None and base_env.max_episode_length:
        view = base_env.view
        view.time_out_offset_E.copy_(base_env.max_episode_length - view.episode_step_E - 1)


def copy_of(value: PyTree) -> PyTree:
    """Return a copy of a tensor; anything else as it is."""
    if isinstance(value, Tensor):
        return value.clone()
    return value


def differing(one: TensorDictBase, other: TensorDictBase, rows: Sequence[int]) -> list[NestedKey]:
    """Return the keys whose values differ by a single bit in any of `rows` (NaN equals NaN)."""
    return [
        key
        for key in one.keys(True, True)
        if not same_bits(one.get(key)[list(rows)], other.get(key)[list(rows)])
    ]


def same_bits(one: Shaped[Tensor, "*leaf"], other: Shaped[Tensor, "*leaf"]) -> bool:
    """Whether two tensors hold the same bits: a NaN equals itself, and a zero without a sign is another."""
    return torch.equal(_bits(one), _bits(other))


def _bits(value: Tensor) -> Tensor:
    # As whole numbers, for which NaN equals NaN and 0 differs from -0.
    whole = {torch.float32: torch.int32, torch.float64: torch.int64}.get(value.dtype)
    if whole is None:
        return value
    return value.contiguous().view(whole)
