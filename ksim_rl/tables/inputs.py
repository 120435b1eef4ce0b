"""What a row reads beside its settings: files, and run folders of the rows that it learns from."""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ksim_rl.files.reading import MOST_TENSOR_BYTES, MOST_TEXT_BYTES, check_regular, read_bytes
from ksim_rl.files.writing import write_whole
from ksim_rl.runs.record import read as read_sessions
from ksim_rl.tables.levels import Result
from ksim_rl.tables.lineage import overrides_of, run_of, sources_of
from ksim_rl.tables.table import Row
from ksim_rl.terminal import printable
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.checkpoint import MANIFEST, CheckpointError, load_latest
from ksim_rl.trainers.kept_models import ReadFile
from ksim_rl.trainers.kept_models import files_read as files_of_run
from ksim_rl.trainers.sources import checkpoints_of, recordings_of

# In the run folder of a seed of a row, once all of it is done.
FINISHED = "row.json"
# What tells the run of a result from all others.
OF_RESULT = ("settings", "files", "commit", "date")


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Where a row finds the runs of the rows that it learns from.

    Attributes:
        runs: the folder of all runs of the table.
        fits: whether a result of a row, by name, is of the settings and files that the row has now.
        results: the folder of the table's results, of which these runs have to be; None where there are none.
    """

    runs: Path
    fits: Callable[[str, Result], bool]
    results: Path | None = None

    def of(self, row: Row, seed: int) -> dict[str, Result]:
        """Return what the finished runs of a row's sources say of themselves, by name; see `write_finished`.

        A ValueError names a run that is not there or not finished, or that is none of its row and its result.
        """
        found = {}
        for name in sources_of(row):
            finished = self.finished(name, seed)
            if isinstance(finished, str):
                raise ValueError(f"row {name!r}, which this row learns from: {finished}")
            found[name] = finished
        return found

    def folders(self, row: Row, seed: int) -> dict[str, Path]:
        """Return the run folders of the rows that a row learns from, by name."""
        return {name: run_of(self.runs, name, seed) for name in sources_of(row)}

    def finished(self, name: str, seed: int) -> Result | str:
        """Return what the finished run of a row says of itself, or why there is none that others may learn from."""
        try:
            return self._finished(name, seed)
        # Of a stranger's file.
        except ValueError as error:
            return f"{error}; {self._fix(name, seed)}"

    def _finished(self, name: str, seed: int) -> Result | str:
        folder = run_of(self.runs, name, seed)
        path = folder / FINISHED
        if not path.exists():
            return f"{folder} is no finished run of it with seed {seed}; {self._fix(name, seed)}"
        finished = _facts(path)
        sessions = read_sessions(folder)
        # Whoever went on with the run by hand has other networks in its folder.
        is_last = bool(sessions) and sessions[-1].began == finished["date"]
        if finished["seed"] != seed or not is_last or not self.fits(name, finished):
            return f"{folder} is a run of another seed, other settings or other files; {self._fix(name, seed)}"
        if self.results is None:
            return finished
        result = self.results / name / f"seed_{seed}.json"
        if not result.exists():
            return finished
        counted = _facts(result)
        if any(counted[key] != finished[key] for key in OF_RESULT):
            return f"{folder} is another run than {result} is of; {self._fix(name, seed)}"
        return finished

    def _fix(self, name: str, seed: int) -> str:
        fix = "let ksim-rl reproduce run that row"
        if self.results is None:
            return fix
        result = self.results / name / f"seed_{seed}.json"
        if not result.exists():
            return fix
        return f"move {result} away, and {fix} again"


def _facts(path: Path) -> Result:
    """Return what tells a run from all others, by its result or by `write_finished`; a ValueError for other files."""
    try:
        tree = json.loads(read_bytes(path, limit=MOST_TEXT_BYTES))
        facts = {key: str(tree[key]) for key in OF_RESULT if key != "files"}
        hashes = {str(name): str(sha256) for name, sha256 in tree.get("files", {}).items()}
        return {**facts, "files": hashes, "seed": tree.get("seed")}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        what = printable(f"{type(error).__name__} {error}")
        raise ValueError(f"{path}: no record of a row's run: {what}") from error


def write_finished(run_folder: Path, result: Result, seed: int) -> None:
    """Say in a run folder which run it is: settings, files, commit and date of its result, and its seed."""
    finished = {"seed": seed, **{key: result[key] for key in OF_RESULT}}
    write_whole(run_folder / FINISHED, json.dumps(finished, indent=1) + "\n")


def clear_finished(run_folder: Path) -> None:
    """Say in a run folder that its run is not finished any more, as it starts again."""
    (run_folder / FINISHED).unlink(missing_ok=True)


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


class FilesHere:
    """The files that a row reads, as they are on this machine: each is hashed once, where it is asked for."""

    def __init__(self, files: Iterable[ReadFile]) -> None:
        self._files = tuple(files)
        self._hashes: dict[str, str] | None = None

    def fit(self, recorded: Mapping[str, str] | None) -> bool:
        """Return whether these are the files that a result has `recorded`.

        Files that cannot be read here are taken for unchanged. A result of before there were records counts where its
        row reads no files of the user's own.
        """
        if recorded is None:
            return not any(file.is_own for file in self._files)
        # Only now: models of the menagerie may have to be downloaded.
        if self._hashes is None:
            self._hashes = {}
            for file in self._files:
                with suppress(ValueError, OSError):
                    self._hashes[file.name] = file.sha256()
        return all(recorded.get(name) == sha256 for name, sha256 in self._hashes.items())


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
