"""Reads recorded episodes for a policy that shall learn from them, and keeps some of them apart."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Int64
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.algorithms.recorded import check_leaves
from ksim_rl.checks import naming
from ksim_rl.data import read_episodes
from ksim_rl.data.dataset_storage import MASK_KEY, finite_rows
from ksim_rl.data.episode_folder import EPISODE_KEY


@dataclass(frozen=True, kw_only=True)
class Demonstration:
    """Env states to learn from, `["N"]`, and env states of other episodes to measure on, None without.

    Held-out rows with a non-finite number are masked: `("collector", "mask")` is False there.
    """

    learned_N: TensorDictBase
    held_out_N: TensorDictBase | None


def read_demonstration(
    folder: Path, env: EnvBase, *, keys: list[NestedKey], held_out: float, device: torch.device
) -> Demonstration:
    """Read the leaves at `keys`, observations of a policy and "action", onto a device.

    A ValueError names a leaf that the folder lacks or has in another shape than the env, observations whose columns
    are other terms, and actions that are no continuous numbers.
    """
    with naming(f"objective.episodes={str(folder)!r}"):
        found = read_episodes(folder)
        check_leaves(found.contents, env, keys)
    env_states_D = found.env_states_D.select(*keys)
    is_held_out_D = _held_out(found.env_states_D.get(EPISODE_KEY), held_out)
    learned_N = _taken(env_states_D, ~is_held_out_D, device)
    if not is_held_out_D.any():
        return Demonstration(learned_N=learned_N, held_out_N=None)
    held_out_N = _taken(env_states_D, is_held_out_D, device)
    # What is learned goes through a dataset, which masks such rows itself.
    held_out_N[MASK_KEY] = finite_rows(list(held_out_N.values(True, True)))
    return Demonstration(learned_N=learned_N, held_out_N=held_out_N)


def _held_out(episode_D: Int64[Tensor, " D"], share: float) -> Bool[Tensor, " D"]:
    """Return which env states are of episodes that are kept apart: a share of them, evenly spaced."""
    # With a share of 0.1 each tenth episode.
    return ((episode_D + 1) * share).floor() > (episode_D * share).floor()


def _taken(
    env_states_D: TensorDictBase, where_D: Bool[Tensor, " D"], device: torch.device
) -> TensorDictBase:
    rows_N = where_D.nonzero()[:, 0]
    taken = TensorDict(batch_size=[len(rows_N)], device=device)
    for key, value_D in env_states_D.items(True, True):
        taken.set(key, value_D[rows_N].to(device))
    return taken
