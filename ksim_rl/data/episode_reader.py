"""Reads a folder of episodes, which may be a stranger's, as a TensorDict or as a TorchRL replay buffer."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int64, Shaped
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, TensorStorage
from torchrl.data.replay_buffers import Sampler

from ksim_rl import dims
from ksim_rl.data.episode_folder import (
    ENV_STATES,
    EPISODE_KEY,
    Contents,
    Leaf,
    read_contents,
    write_contents,
)
from ksim_rl.files.reading import open_regular
from ksim_rl.files.writing import check_links

# Of one leaf: it is mapped, and no memory is taken for it.
MOST_LEAF_BYTES = 2**42
# Env states whose numbers of episodes are read at once.
MOST_CHECKED = 2**22


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Whole episodes, one after the other, `["D"]`: on the CPU pages of their files, read when they are used."""

    contents: Contents
    env_states_D: TensorDict


def read_episodes(folder: Path | str) -> Episodes:
    """Return the whole episodes of a folder; writing into their numbers changes memory, and no file.

    A ValueError names what is damaged: `episodes.json`, or a file of a leaf that is shorter than it says. Nothing in
    the folder is run, and nothing is written.
    """
    folder = Path(folder)
    contents = read_contents(folder)
    if not contents.num_env_states:
        raise ValueError(f"{folder}: no whole episode in it")
    size = contents.num_env_states
    leaves = {leaf.key: _mapped(leaf, folder, size) for leaf in contents.leaves}
    _check_order(leaves[EPISODE_KEY], folder, contents.num_episodes)
    env_states_D = TensorDict(batch_size=[size])
    for key, leaf_D in leaves.items():
        env_states_D.set(key, leaf_D)
    return Episodes(contents=contents, env_states_D=dims.name(env_states_D, dims.D))


def mend(folder: Path | str) -> None:
    """Renew the sizes that TensorDict reads, from `episodes.json`.

    Where a process was killed within a commit, some of them are of the commit before: then `load_memmap` raises a
    RuntimeError, while `read_episodes` and `load` of this library go by `episodes.json` and need none of this. A
    ValueError names what is damaged, as in `read_episodes`: no size is written that a file does not have.
    """
    folder = Path(folder)
    check_links(folder, below=(ENV_STATES,))
    contents = read_contents(folder)
    if contents.num_env_states:
        read_episodes(folder)
    write_contents(folder, contents)


def load(
    folder: Path | str,
    *,
    sampler: Sampler | None = None,
    batch_size: int | None = None,
    device: torch.device | str = "cpu",
) -> ReplayBuffer:
    """Return the episodes of a folder as a TorchRL replay buffer of one dim, whose entries are env states.

    Any sampler for storages of one dim draws from it: `EpochSampler`, `PrioritySampler`, and TorchRL's, of which
    `SliceSampler(traj_key="episode", ...)` draws sequences. Without one, draws are uniform, with replacement. On the
    CPU numbers stay in their files until they are drawn; another `device` takes all of them. Nothing can be added. See
    `read_episodes` for errors.
    """
    env_states_D = read_episodes(folder).env_states_D
    if torch.device(device).type != "cpu":
        env_states_D = env_states_D.to(device)
    if sampler is not None:
        # Samplers with priorities draw only what was announced to them.
        sampler.extend(torch.arange(len(env_states_D)))
    return ReplayBuffer(
        storage=TensorStorage(env_states_D),
        sampler=sampler,
        writer=ImmutableDatasetWriter(),
        batch_size=batch_size,
    )


def _check_order(episode_D: Int64[Tensor, " D"], folder: Path, num_episodes: int) -> None:
    """Refuse env states that are not of episode 0, then of episode 1, and so on."""
    before = torch.zeros(1, dtype=torch.int64)
    # In pieces, since a folder may be larger than memory.
    for piece_D in episode_D.split(MOST_CHECKED):
        step_D = torch.diff(piece_D, prepend=before)
        before = piece_D[-1:]
        if ((step_D != 0) & (step_D != 1)).any():
            break
    else:
        if episode_D[0] == 0 and before == num_episodes - 1:
            return
    raise ValueError(
        f"{folder}: damaged: its env states are not of episodes 0 to {num_episodes - 1}, one after the other"
    )


def _mapped(leaf: Leaf, folder: Path, num_rows: int) -> Shaped[Tensor, "D *?leaf"]:
    """Map the first rows of a leaf's file into memory, privately: writes do not reach the file."""
    path = leaf.path(folder)
    needed = num_rows * leaf.num_bytes
    # The file that was checked is the one that is mapped.
    with open_regular(path, limit=MOST_LEAF_BYTES) as file:
        size = file.seek(0, 2)
        # Beyond the end of its file a map has no memory: a process that reads there dies.
        if size < needed:
            raise ValueError(
                f"{path}: damaged: {size} bytes, and {num_rows} env states need {needed}"
            )
        if needed == 0:
            bytes_N = np.zeros(0, dtype=np.uint8)
        else:
            bytes_N = np.memmap(file, dtype=np.uint8, mode="c", shape=(needed,))
    numbers = torch.from_numpy(bytes_N)
    if leaf.torch_dtype == torch.bool:
        # A stranger's byte may be neither 0 nor 1, and torch computes with bits of truths as they lie there.
        return (numbers != 0).view(num_rows, *leaf.shape)
    return numbers.view(leaf.torch_dtype).view(num_rows, *leaf.shape)
