"""What a row reads beside its settings: files, and run folders of the rows that it learns from."""

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from ksim_rl.files.reading import MOST_TENSOR_BYTES, check_regular
from ksim_rl.tables.lineage import overrides_of, run_of, sources_of
from ksim_rl.tables.table import Row
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.checkpoint import MANIFEST, CheckpointError, load_latest
from ksim_rl.trainers.kept_models import ReadFile
from ksim_rl.trainers.kept_models import files_read as files_of_run
from ksim_rl.trainers.sources import checkpoints_of, recordings_of


@dataclass(frozen=True, kw_only=True)
class Sources:
    """What a row may find of the rows that it learns from.

    Attributes:
        runs: the folder of all runs of the table.
        settings: the fingerprints of these rows, by name.
        files: the hashes of the files that these rows read, with the names of the rows in front.
    """

    runs: Path
    settings: Mapping[str, str]
    files: Mapping[str, str] = field(default_factory=dict)

    def folders(self, row: Row, seed: int) -> dict[str, Path]:
        """Return the run folders of the rows that a row learns from, by name.

        A ValueError names one that is not there.
        """
        found = {}
        for name in sources_of(row):
            folder = run_of(self.runs, name, seed)
            if not folder.is_dir():
                raise ValueError(
                    f"{folder}: no run of row {name!r} with seed {seed}, which this row learns from: let ksim-rl "
                    "reproduce run that row first"
                )
            found[name] = folder
        return found


def files_read(cfg: RunCfg, row: Row) -> Iterator[ReadFile]:
    """Yield what a row reads: models, motions and other data, and recordings and checkpoints that its overrides name.

    `cfg` names the rows that it learns from; what lies in their folders is theirs.
    """
    yield from files_of_run(cfg)
    of_rows = {word.partition("=")[0] for word in overrides_of(row)}
    for name, path in recordings_of(cfg).items():
        # The field, since an override replaces the whole of `data.offline`.
        if not of_rows & {name, name.rpartition(".")[0]}:
            yield ReadFile(name=name, sha256=partial(_sha256_of_folder, Path(path)), is_own=True)
    for name, path in checkpoints_of(cfg).items():
        if name not in of_rows:
            yield ReadFile(
                name=name, sha256=partial(_sha256_of_checkpoint, Path(path)), is_own=True
            )


def hashes_of(files: Iterable[ReadFile]) -> dict[str, str]:
    """Return the hashes of files by their names; a ValueError names one that cannot be read."""
    return {file.name: file.sha256() for file in files}


@dataclass(frozen=True, kw_only=True)
class FilesHere:
    """The files that a row reads and that are on this machine.

    Attributes:
        hashes: by name.
        reads_own: whether the row reads files of the user's own, here or elsewhere.
    """

    hashes: Mapping[str, str]
    reads_own: bool

    @classmethod
    def of(cls, files: Iterable[ReadFile]) -> "FilesHere":
        """Read them; files that cannot be read are left out."""
        hashes = {}
        reads_own = False
        for file in files:
            reads_own = reads_own or file.is_own
            with suppress(ValueError, OSError):
                hashes[file.name] = file.sha256()
        return cls(hashes=hashes, reads_own=reads_own)

    def fit(self, recorded: Mapping[str, str] | None) -> bool:
        """Return whether these are the files that a result has `recorded`.

        Files that are not here are taken for unchanged. A result of before there were records counts where its row
        reads no files of the user's own.
        """
        if recorded is None:
            return not self.reads_own
        return all(recorded.get(name) == sha256 for name, sha256 in self.hashes.items())


def _sha256_of_folder(folder: Path) -> str:
    """Return the hash of the names and contents of all files below a folder of episodes."""
    if not folder.is_dir():
        raise ValueError(f"{folder}: missing: expected a folder of episodes")
    total = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if not path.is_dir():
            total.update(os.fsencode(f"{path.relative_to(folder)}\n{_sha256_of_file(path)}\n"))
    return total.hexdigest()


def _sha256_of_checkpoint(path: Path) -> str:
    """Return the hash of the newest whole checkpoint, whose manifest has the hashes of its tensors."""
    try:
        newest = load_latest(path).path
    except CheckpointError as error:
        raise ValueError(str(error)) from error
    return _sha256_of_file(newest / MANIFEST)


def _sha256_of_file(path: Path) -> str:
    """Return the hash of a file that may be larger than what fits into memory."""
    check_regular(path, limit=MOST_TENSOR_BYTES)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
