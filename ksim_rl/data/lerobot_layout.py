"""Which column, which file and which name each number of an episode has in a dataset of LeRobot."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from ksim_rl.data.episode_folder import EPISODE_KEY, Contents, Leaf
from ksim_rl.data.episode_reader import Episodes

FILES_PER_CHUNK = 1000
# Of one file, before compression.
MOST_NUMBER_BYTES = 100 * 2**20
MOST_PICTURE_BYTES = 4 * 2**30


@dataclass(frozen=True, kw_only=True)
class Feature:
    """A column of the dataset, and the leaf that it is made of."""

    name: str
    leaf: Leaf
    names: Sequence[str] | None = None

    @property
    def is_video(self) -> bool:
        """Whether it is of pictures."""
        return self.leaf.is_picture

    @property
    def size(self) -> int:
        """Numbers in a frame."""
        return torch.Size(self.leaf.shape).numel()

    @property
    def about(self) -> dict[str, Any]:
        """Its entry of `info.json`."""
        if self.is_video:
            height, width, _ = self.leaf.shape
            names = ["height", "width", "channels"]
            return {"dtype": "video", "shape": [height, width, 3], "names": names}
        return {"dtype": self.leaf.dtype, "shape": [self.size], "names": self.names}


@dataclass(frozen=True, kw_only=True)
class DataFile:
    """Which frames [start, stop) of the dataset a file has, by episode."""

    number: int
    episodes: Mapping[int, tuple[int, int]]

    @property
    def frames(self) -> slice:
        """All of its frames."""
        spans = list(self.episodes.values())
        return slice(spans[0][0], spans[-1][1])

    @property
    def name(self) -> str:
        """Its path without a suffix, below the folder of its kind."""
        chunk, file = self.place
        return f"chunk-{chunk:03d}/file-{file:03d}"

    @property
    def place(self) -> tuple[int, int]:
        """The numbers of its chunk and of the file in it."""
        return divmod(self.number, FILES_PER_CHUNK)


def features_of(contents: Contents) -> list[Feature]:
    """Return the columns of a dataset; a ValueError where two leaves would have the same name."""
    features = []
    for leaf in contents.leaves:
        if leaf.key == EPISODE_KEY:
            continue
        name = _name(leaf)
        if name is not None:
            names = _column_names(contents, leaf)
            features.append(Feature(name=name, leaf=leaf, names=names))
    names = [feature.name for feature in features]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two leaves would be called {name} in a dataset of LeRobot")
    return features


def _name(leaf: Leaf) -> str | None:
    """Return LeRobot's name for a leaf, or None if the next frame has the leaf."""
    first, *rest = leaf.key
    if first == "next":
        if rest[0] in ("reward", "done", "terminated", "truncated"):
            return f"next.{'.'.join(rest)}"
        return None
    if leaf.key == ("action",):
        return "action"
    if leaf.key == ("actor",):
        return "observation.state"
    # "obs" is where terms lie, and says no more than "observation".
    if first == "obs" and rest:
        path = rest
    else:
        path = [first, *rest]
    if leaf.is_picture:
        path = ["images", *path]
    return ".".join(["observation", *path])


def _column_names(contents: Contents, leaf: Leaf) -> list[str] | None:
    """Return a name for each column of an observation group, None for other leaves."""
    terms = contents.origin.columns.get("/".join(leaf.key))
    if terms is None or len(leaf.shape) != 1:
        return None
    names = [""] * leaf.shape[0]
    for term, (start, stop) in terms.items():
        for column in range(start, stop):
            names[column] = f"{term}.{column - start}"
    return names


def files_of(episodes: Episodes, features: Sequence[Feature]) -> Iterator[DataFile]:
    """Share the episodes out to files, each as full as it may be."""
    pictures = sum(feature.leaf.num_bytes for feature in features if feature.is_video)
    numbers = sum(feature.leaf.num_bytes for feature in features if not feature.is_video)
    most = MOST_NUMBER_BYTES // max(numbers, 1)
    if pictures:
        most = min(most, MOST_PICTURE_BYTES // pictures)
    held: dict[int, tuple[int, int]] = {}
    number = 0
    frames = 0
    for episode, (start, stop) in enumerate(_spans(episodes)):
        # At least one episode, however long it is.
        if held and frames + stop - start > most:
            yield DataFile(number=number, episodes=held)
            held = {}
            number += 1
            frames = 0
        held[episode] = (start, stop)
        frames += stop - start
    yield DataFile(number=number, episodes=held)


def _spans(episodes: Episodes) -> list[tuple[int, int]]:
    """Return the env states [start, stop) of each episode."""
    number_D = episodes.env_states_D.get(EPISODE_KEY)
    lengths = torch.unique_consecutive(number_D, return_counts=True)[1]
    stops = lengths.cumsum(0)
    starts = stops - lengths
    return list(zip(starts.tolist(), stops.tolist(), strict=True))
