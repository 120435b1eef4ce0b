"""Compares recorded episodes with the env of a run that shall learn from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase

from ksim_rl.checks import naming
from ksim_rl.data import OfflineTable, ReplayCfg, make_offline_table, offline_keys, read_episodes
from ksim_rl.data.episode_folder import EPISODE_KEY, Contents
from ksim_rl.envs.contract import EpisodeClock, SimulatedWorld, part
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.recorders import model_sha256
from ksim_rl.transforms import observation_columns, stacked_frames
from ksim_rl.transforms.specs import path_of, spell


def check_leaves(contents: Contents, env: EnvBase, keys: Sequence[NestedKey]) -> None:
    """Refuse leaves at `keys` that are not there or have another shape than the env's, and columns of other terms."""
    known = {spell(leaf.key): leaf for leaf in contents.leaves}
    # An action has a spec of its own.
    now: Any = env.observation_spec.clone()
    action: Any = env.action_spec
    if env.action_keys != ["action"] or not action.dtype.is_floating_point:
        raise ValueError(
            "the env's actions are choices, and learning from recorded episodes is for continuous ones"
        )
    now["action"] = action
    following: Any = env.observation_spec.clone()
    for spec in (env.full_reward_spec, env.full_done_spec):
        following.update(spec)
    for key in keys:
        name = spell(key)
        first, *rest = path_of(key)
        if first == "next":
            spec = following[tuple(rest)]
        else:
            spec = now[key]
        shape = list(spec.shape[1:])
        if name not in known:
            raise ValueError(
                f"it has no {name!r}, which learning needs; it has {', '.join(sorted(known))}"
            )
        leaf = known[name]
        if list(leaf.shape) != shape or leaf.torch_dtype != spec.dtype:
            raise ValueError(
                f"its {name!r} is {leaf.dtype} {list(leaf.shape)}, and the env's {spec.dtype} {shape}"
            )
    _check_columns(contents, env, [spell(key) for key in keys])


def _check_columns(contents: Contents, env: EnvBase, read: Sequence[str]) -> None:
    """Refuse groups of equal sizes with other terms, which would be learned in silence."""
    theirs = {
        group: {term: list(ends) for term, ends in terms.items()}
        for group, terms in contents.origin.columns.items()
    }
    ours = observation_columns(env)
    shared = [group for group in read if group in theirs and group in ours]
    checkpoint.check_columns(
        {group: theirs[group] for group in shared}, {group: ours[group] for group in shared}
    )


def check_origin(contents: Contents, env: EnvBase) -> list[str]:
    """Refuse episodes of another model or control rate; return a note for each of them that the folder does not say."""
    origin = contents.origin
    clock = part(env, EpisodeClock)
    world = part(env, SimulatedWorld)
    notes = []
    if not origin.step_dt or clock is None:
        notes.append("the seconds of a step")
    # As written in JSON, which keeps all digits.
    elif origin.step_dt != clock.step_dt:
        raise ValueError(
            f"step_dt: a step of its env took {origin.step_dt:g} s, and here one takes {clock.step_dt:g} s: set "
            "task.decimation or the model's timestep as there"
        )
    if not origin.model_sha256 or world is None:
        notes.append("the MuJoCo model")
    elif (own := model_sha256(world)) != origin.model_sha256:
        raise ValueError(
            f"model_sha256: its MuJoCo model was {origin.model_sha256[:12]}, and this run's is {own[:12]}: train "
            "with the robot and scene that were recorded, which its config.yaml has"
        )
    return notes


def read_offline_table(
    data: ReplayCfg,
    env: EnvBase,
    *,
    observations: list[NestedKey],
    gamma: float,
    device: torch.device,
) -> tuple[OfflineTable, list[str]]:
    """Read `data.offline.source` onto a device; return it with notes of what could not be compared.

    A ValueError names a leaf, the control rate or the model where it differs from the env's.
    """
    assert data.offline is not None
    folder = Path(data.offline.source)
    with naming(f"data.offline.source={str(folder)!r}"):
        found = read_episodes(folder)
        keys = offline_keys(observations)
        check_leaves(found.contents, env, keys)
        unknown = check_origin(found.contents, env)
        table = make_offline_table(
            found.env_states_D.select(*keys, EPISODE_KEY),
            observations=observations,
            shards=data.shards,
            n_step=data.n_step,
            gamma=gamma,
            device=device,
            beside=_replay_bytes(data, env, observations),
        )
    notes = [f"data.offline.source={folder}: not compared with this env: {it}" for it in unknown]
    return table, notes


def _replay_bytes(data: ReplayCfg, env: EnvBase, observations: Sequence[NestedKey]) -> int:
    """Return how many bytes the observations of a run's own replay take, which keeps each frame of a stack once."""
    stacks = stacked_frames(env)
    total = 0
    for key in observations:
        spec = env.observation_spec[key]
        # Of all envs.
        total += spec.shape.numel() * spec.dtype.itemsize // len(stacks.get(key, (0,)))
    return data.capacity * total
