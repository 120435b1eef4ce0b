"""Reads and writes the entries of the zoo: a card, a checkpoint and an ONNX file for each policy.

An entry is a folder `policies/<name>`: `card.json`, `policy.onnx`, and `checkpoint/<iteration>` with the actor alone.
All of it is data, and is read by the rules for run folders of strangers: checked by hash, never executed.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ksim_rl.checked import Checked, Seed, Total, WholeNumber
from ksim_rl.checks import near
from ksim_rl.files.reading import read_bytes
from ksim_rl.terminal import printable

FOLDER = Path(__file__).parent / "policies"
TRANSFER = Path(__file__).parent / "transfer"
"""The numbers of the transfer cards of the package's policies, `<name>.json`, by `python -m benchmarks.cards`."""
CARD = "card.json"
ONNX = "policy.onnx"
CHECKPOINT = "checkpoint"
# Of one entry: the whole zoo is a part of the package.
MOST_BYTES = 200_000


@dataclass(frozen=True, kw_only=True)
class Card(Checked):
    """The record of a policy: its training, its return, and the SHA-256 of its files.

    `curve` has pairs of env states and mean return of training episodes; `sim2sim` the share that MuJoCo's C engine
    earned of the recorded return (`return_ratio`), its standard error and the episodes.
    """

    name: str
    task: str
    commit: str
    seed: Seed
    num_envs: WholeNumber
    iteration: WholeNumber
    env_states: Total
    return_mean: float | None = None
    curve: Sequence[tuple[int, float]] = ()
    sim2sim: Mapping[str, float] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)


def cards(folder: Path = FOLDER) -> list[Card]:
    """Return the cards of all entries, by name."""
    return [read_card(name, folder) for name in _names(folder)]


def _names(folder: Path) -> list[str]:
    return sorted(path.parent.name for path in folder.glob(f"*/{CARD}"))


def read_card(name: str, folder: Path = FOLDER) -> Card:
    """Return an entry's card, after its files were compared with it; a ValueError names a missing or different file."""
    if name not in (known := _names(folder)):
        raise ValueError(f"zoo:{name}: no such policy: {near(name, known)}")
    path = folder / name / CARD
    try:
        # Read as a stranger's file, as `--folder` may name any.
        tree = json.loads(read_bytes(path, limit=MOST_BYTES))
        # Texts are shown on a terminal.
        plain: Any = {key: printable(v) if isinstance(v, str) else v for key, v in tree.items()}
        card = Card(**plain)
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path}: no card: {printable(str(error))}") from error
    # A changed or missing file would be another policy under the same name.
    if card.name != name or hashes(path.parent) != dict(card.files):
        raise ValueError(
            f"{path.parent}: its files differ from what its card says: install the package once more"
        )
    return card


def read_transfer(name: str, folder: Path = TRANSFER) -> dict[str, Any] | None:
    """Return the numbers of a policy's transfer card, or None of one that was not judged."""
    path = folder / f"{name}.json"
    if not path.exists():
        return None
    return json.loads(read_bytes(path, limit=MOST_BYTES))


def hashes(entry: Path) -> dict[str, str]:
    """Return the SHA-256 of each file but the card; a ValueError refuses links and large files."""
    # Links are kept in the list, so that reading refuses them.
    paths = [path for path in sorted(entry.rglob("*")) if path.is_symlink() or not path.is_dir()]
    files = {str(path.relative_to(entry)): read_bytes(path, limit=MOST_BYTES) for path in paths}
    files.pop(CARD, None)
    return {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
