"""Reads recorded episodes for a policy that shall learn from them, and keeps some of them apart."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Int64
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.checks import naming
from ksim_rl.data import Episodes, read_episodes
from ksim_rl.data.dataset_storage import MASK_KEY, finite_rows
from ksim_rl.data.episode_folder import EPISODE_KEY
from ksim_rl.trainers import checkpoint
from ksim_rl.transforms import observation_columns
from ksim_rl.transforms.specs import spell


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
        _check(found, env, keys)
    env_states_D = found.env_states_D.select(*keys)
    is_held_out_D = _held_out(found.env_states_D.get(EPISODE_KEY), held_out)
    learned_N = _taken(env_states_D, ~is_held_out_D, device)
    if not is_held_out_D.any():
        return Demonstration(learned_N=learned_N, held_out_N=None)
    held_out_N = _taken(env_states_D, is_held_out_D, device)
    # What is learned goes through a dataset, which masks such rows itself.
    held_out_N[MASK_KEY] = finite_rows(list(held_out_N.values(True, True)))
    return Demonstration(learned_N=learned_N, held_out_N=held_out_N)


def _check(found: Episodes, env: EnvBase, keys: list[NestedKey]) -> None:
    known = {spell(leaf.key): leaf for leaf in found.contents.leaves}
    # An action has a spec of its own.
    spec: Any = env.observation_spec.clone()
    action: Any = env.action_spec
    if env.action_keys != ["action"] or not action.dtype.is_floating_point:
        raise ValueError(
            "the env's actions are choices, and behavior cloning is for continuous ones"
        )
    spec["action"] = action
    for key in keys:
        name = spell(key)
        shape = list(spec[key].shape[1:])
        if name not in known:
            raise ValueError(f"it has no {name!r}, which the policy needs; it has {sorted(known)}")
        leaf = known[name]
        if list(leaf.shape) != shape or leaf.torch_dtype != spec[key].dtype:
            raise ValueError(
                f"its {name!r} is {leaf.dtype} {list(leaf.shape)}, and the env's {spec[key].dtype} {shape}"
            )
    # Equal sizes with other terms would be learned in silence.
    theirs = {
        group: {term: list(ends) for term, ends in terms.items()}
        for group, terms in found.contents.origin.columns.items()
    }
    ours = observation_columns(env)
    read = [spell(key) for key in keys]
    checkpoint.check_columns(
        *(
            {group: columns[group] for group in read if group in theirs and group in ours}
            for columns in (theirs, ours)
        )
    )


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
