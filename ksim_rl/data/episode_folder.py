"""The layout of a folder of episodes: whole episodes of an env, one env state after the other, as memory maps.

`env_states` is a TensorDict `["D"]` as `TensorDict.memmap` writes it. `episodes.json` says how many episodes and env
states are whole, what a leaf of an env state is, and where it all came from. A writer adds rows to the files of
the leaves first, then renews the sizes, from the inner TensorDicts to the outer one, and `episodes.json` last: a file
may hold rows of an episode that was not finished, and no size says so.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch

from ksim_rl.checked import Checked, NonNegative, WholeNumber, Within
from ksim_rl.files.reading import MOST_CONFIG_BYTES, read_bytes
from ksim_rl.files.writing import write_whole
from ksim_rl.terminal import printable

CONTENTS = "episodes.json"
ENV_STATES = "env_states"
SIZES = "meta.json"  # of each TensorDict in `env_states`
MAP_SUFFIX = ".memmap"
FORMAT = 1
EPISODE_KEY = ("episode",)
"""The number of an env state's episode, int64; TorchRL's `SliceSampler` looks for it there."""
Key = tuple[str, ...]
# The types of numbers that torch, NumPy, Parquet and LeRobot know alike.
DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (
        torch.bool,
        torch.uint8,
        torch.int8,
        torch.int16,
        torch.int32,
        torch.int64,
        torch.float16,
        torch.float32,
        torch.float64,
    )
}
# A name is also the name of a file or folder: nothing that could lead out, and nothing that TensorDict would spell
# otherwise.
_NAME = re.compile(r"\w[\w.\-\[\]]*", re.ASCII)
MOST_DIMS = 8


@dataclass(frozen=True, kw_only=True)
class Leaf(Checked):
    """A leaf of an env state: its key, its shape in one env state, and the name of its dtype."""

    key: Key
    shape: tuple[WholeNumber, ...] = ()
    dtype: str = "float32"

    def _check_fields(self) -> None:
        super()._check_fields()
        if not self.key:
            raise ValueError("key=(): expected at least one name")
        for name in self.key:
            if not _NAME.fullmatch(name):
                raise ValueError(
                    f"key={self.key!r}: {name!r} cannot be the name of a file: use letters, digits, '_', '.' and '-'"
                )
        if self.dtype not in DTYPES:
            raise ValueError(
                f"dtype={self.dtype!r} of {'/'.join(self.key)}: expected one of {', '.join(DTYPES)}"
            )
        if len(self.shape) > MOST_DIMS:
            raise ValueError(
                f"shape={self.shape} of {'/'.join(self.key)}: more than {MOST_DIMS} dims"
            )
        # TensorDict maps no file without bytes.
        if 0 in self.shape:
            raise ValueError(f"shape={self.shape} of {'/'.join(self.key)}: no number in it")

    @property
    def torch_dtype(self) -> torch.dtype:
        """Its dtype."""
        return DTYPES[self.dtype]

    @property
    def num_bytes(self) -> int:
        """Bytes of one env state."""
        return torch.Size(self.shape).numel() * self.torch_dtype.itemsize

    @property
    def dims(self) -> str:
        """The letters of its dims in the folder, such as "DL", or "DHWC" of a picture."""
        if self.is_picture:
            return "DHWC"
        return "D" + "L" * len(self.shape)

    @property
    def is_picture(self) -> bool:
        """Whether it is a picture: bytes in rows, columns and one or three channels."""
        return self.dtype == "uint8" and len(self.shape) == 3 and self.shape[2] in (1, 3)

    def path(self, folder: Path) -> Path:
        """Return the file of its numbers in a folder of episodes."""
        above = folder.joinpath(ENV_STATES, *self.key[:-1])
        return above / f"{self.key[-1]}{MAP_SUFFIX}"


EPISODE = Leaf(key=EPISODE_KEY, dtype="int64")


@dataclass(frozen=True, kw_only=True)
class Origin(Checked):
    """Where episodes came from.

    Attributes:
        task: the name of the task.
        policy: what acted, in words.
        step_dt: seconds from one env state to the next, 0 where the env does not say.
        weights_sha256: of the policy's weights.
        model_sha256: of the compiled MuJoCo model.
        columns: the columns [start, stop) of each term in an observation group, by group.
    """

    task: str = ""
    policy: str = ""
    step_dt: NonNegative = 0.0
    weights_sha256: str = ""
    model_sha256: str = ""
    columns: Mapping[str, Mapping[str, tuple[int, int]]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Contents(Checked):
    """The content of a folder of episodes; `asked` is the number of episodes that were to be written, 0 for any."""

    leaves: tuple[Leaf, ...]
    origin: Origin
    asked: WholeNumber = 0
    num_episodes: WholeNumber = 0
    # A fast env takes 32 bits of steps within an hour.
    num_env_states: Annotated[int, Within(low=0, high=2**62)] = 0

    def _check_fields(self) -> None:
        super()._check_fields()
        keys = {leaf.key for leaf in self.leaves}
        if len(keys) != len(self.leaves) or EPISODE not in self.leaves:
            raise ValueError("leaves: expected each key once, and 'episode' among them, one int64")
        for key in keys:
            for length in range(1, len(key)):
                if key[:length] in keys:
                    raise ValueError(f"leaves: {'/'.join(key[:length])} is a leaf and has leaves")
        for leaf in self.leaves:
            self._check_columns(leaf)

    def _check_columns(self, leaf: Leaf) -> None:
        """Refuse terms in columns that a group has not."""
        group = "/".join(leaf.key)
        if len(leaf.shape) != 1:
            return
        width = leaf.shape[0]
        for term, (start, stop) in self.origin.columns.get(group, {}).items():
            if not 0 <= start <= stop <= width:
                raise ValueError(
                    f"columns of {group}: {term!r} is in {start} to {stop}, and there are {width}"
                )


def write_contents(folder: Path, contents: Contents) -> None:
    """Renew `episodes.json`, and the sizes that TensorDict reads; from then on so many rows of the files count."""
    # TensorDict maps no file without bytes, so nothing is there for it before the first episode.
    if contents.num_env_states:
        _write_sizes(folder / ENV_STATES, contents.leaves, contents.num_env_states)
    tree = asdict(contents)
    for leaf, entry in zip(contents.leaves, tree["leaves"], strict=True):
        entry["dims"] = leaf.dims
    text = json.dumps({"format": FORMAT, **tree}, indent=1)
    write_whole(folder / CONTENTS, f"{text}\n")


def _write_sizes(folder: Path, leaves: Sequence[Leaf], num_rows: int) -> None:
    """Write the metadata that `TensorDict.load_memmap` reads, of inner TensorDicts first."""
    below: dict[str, list[Leaf]] = {}
    entries: dict[str, Any] = {}
    for leaf in leaves:
        name, *rest = leaf.key
        if rest:
            below.setdefault(name, []).append(
                Leaf(key=tuple(rest), shape=leaf.shape, dtype=leaf.dtype)
            )
            continue
        entries[name] = {
            "device": "cpu",
            "shape": [num_rows, *leaf.shape],
            "dtype": str(leaf.torch_dtype),
            "is_nested": False,
        }
    for name, inner in below.items():
        _write_sizes(folder / name, inner, num_rows)
        entries[name] = {"type": "TensorDict"}
    about = {"shape": [num_rows], "device": "cpu", "_type": "<class 'tensordict._td.TensorDict'>"}
    write_whole(folder / SIZES, json.dumps({**entries, **about}))


def read_contents(folder: Path) -> Contents:
    """Return the content of a folder of episodes; a ValueError if it is no such folder, or contradicts itself."""
    path = folder / CONTENTS
    try:
        tree = json.loads(read_bytes(path, limit=MOST_CONFIG_BYTES))
        found = tree.pop("format")
        if found != FORMAT:
            raise ValueError(f"format {found!r}, and this version reads {FORMAT}")
        leaves = []
        for entry in tree.pop("leaves"):
            # Dims follow from the rest, and are there for readers.
            entry.pop("dims")
            leaves.append(_leaf(entry))
        origin = tree.pop("origin")
        columns = {
            group: {term: tuple(ends) for term, ends in terms.items()}
            for group, terms in origin.pop("columns").items()
        }
        return Contents(leaves=tuple(leaves), origin=Origin(**origin, columns=columns), **tree)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        what = printable(f"{type(error).__name__} {error}")
        raise ValueError(f"{path}: no contents of a folder of episodes: {what}") from None


def _leaf(entry: Mapping[str, Any]) -> Leaf:
    if not isinstance(entry["key"], list):
        raise ValueError(f"key={entry['key']!r}: expected a list of names")
    return Leaf(key=tuple(entry["key"]), shape=tuple(entry["shape"]), dtype=entry["dtype"])
