"""Writes whole episodes into a new folder, which holds whole ones whenever its process ends."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Shaped

from ksim_rl.checks import check_count
from ksim_rl.data.episode_folder import (
    EPISODE,
    EPISODE_KEY,
    Contents,
    Key,
    Leaf,
    Origin,
    write_contents,
)
from ksim_rl.files.writing import check_folder, make_folder, named, open_new


class EpisodeWriter:
    """Appends episodes to a folder of its own; `commit` makes them count.

    `leaves` make up an env state, without the number of its episode, which the writer adds. A ValueError refuses a
    folder in which something lies. Rows are written plainly, since a full disk ends a process that writes through a
    memory map.

    Attributes:
        contents: what counts by now.
    """

    def __init__(
        self, folder: Path, leaves: Sequence[Leaf], *, origin: Origin, asked: int = 0
    ) -> None:
        check_count("asked", asked, low=0)
        ordered = sorted([*leaves, EPISODE], key=lambda leaf: leaf.key)
        self.contents = Contents(leaves=tuple(ordered), origin=origin, asked=asked)
        self._written = self.contents
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._files: dict[Key, BinaryIO] = {}
        for leaf in self.contents.leaves:
            path = leaf.path(folder)
            make_folder(path.parent, below=folder)
            self._files[leaf.key] = open_new(path)
        write_contents(folder, self.contents)

    def append(self, episode: Mapping[Key, Shaped[np.ndarray, "T *?leaf"]]) -> None:
        """Write the leaves [T, ...] of an episode of T env states; it counts from the next `commit` on."""
        written = self._written
        length = len(next(iter(episode.values())))
        number_T = np.full(length, written.num_episodes, dtype=np.int64)
        with named(self._folder):
            for leaf in written.leaves:
                rows = number_T if leaf.key == EPISODE_KEY else episode[leaf.key]
                assert rows.shape == (length, *leaf.shape), f"{leaf.key}: {rows.shape}"
                self._files[leaf.key].write(np.ascontiguousarray(rows).data)
        self._written = replace(
            written,
            num_episodes=written.num_episodes + 1,
            num_env_states=written.num_env_states + length,
        )

    def commit(self) -> None:
        """Make all episodes count that have been written."""
        if self._written == self.contents:
            return
        with named(self._folder):
            for file in self._files.values():
                file.flush()
        # No link has taken the place of a folder meanwhile.
        for leaf in self._written.leaves:
            check_folder(leaf.path(self._folder).parent, below=self._folder)
        write_contents(self._folder, self._written)
        self.contents = self._written

    def close(self) -> None:
        """Commit, and close the files."""
        try:
            self.commit()
        finally:
            # Each is closed, also after one that a full disk fails at.
            with named(self._folder), ExitStack() as files:
                for file in self._files.values():
                    files.callback(file.close)

    def __enter__(self) -> "EpisodeWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
