"""Checkpoints that survive a crash at any moment, detect any damage, and hold nothing that can execute.

A checkpoint is a folder with `tensors.safetensors` and `manifest.json`. The manifest holds the format version, the
run's resolved config, the plain (JSON) part of the state, and the size and SHA-256 of the tensor file; its own
SHA-256 is its first field. The folder is written under a temporary name, flushed to disk, and renamed into place; the
folder's parent is flushed before an older checkpoint goes. There are no pickles.
"""

import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
from safetensors import SafetensorError

from ksim_rl import ranks
from ksim_rl.checks import MISFITS
from ksim_rl.config.trees import Plain, Tree
from ksim_rl.device import state_tree
from ksim_rl.device.state_tree import State
from ksim_rl.files.reading import MOST_TENSOR_BYTES, read_bytes
from ksim_rl.files.writing import WRITING
from ksim_rl.trainers import checkpoint_formats

MANIFEST = "manifest.json"
TENSORS = "tensors.safetensors"
_DISCARDED = ".discarded-"
RANKS = "ranks"  # of a state: what the other ranks have
_MAX_MANIFEST_BYTES = 16 * 2**20
Columns = Mapping[str, Mapping[str, Sequence[int]]]


class CheckpointError(ValueError):
    """Raised for a checkpoint that is absent, damaged, or of another format; the message says which, and what to do."""


class UnknownFormatError(CheckpointError):
    """Raised for a checkpoint of a format that this version does not read; it may be undamaged."""


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A loaded checkpoint: the state as nested dicts, the config, and the iteration after which it was saved."""

    path: Path
    iteration: int
    config: Tree
    state: state_tree.State

    @property
    def run_folder(self) -> Path:
        """The folder of its run: a checkpoint lies in <run folder>/checkpoint/<iteration>."""
        return self.path.absolute().parent.parent


def save(
    folder: Path,
    state: State,
    *,
    iteration: int,
    config: Tree,
    keep: int = 3,
    trusted: int | None = None,
) -> Path:
    """Write one more checkpoint into `folder`, and drop all but the newest `keep`; an OSError leaves these alone.

    The newest one up to the iteration `trusted` stays as well, since later iterations are not verified yet. With
    several ranks all of them call this; the checkpoint has the state of all, and rank 0 writes.
    """
    # Each rank adds what differs from rank 0's tensors; only then rank 0 comes back here to write.
    if ranks.size() > 1 and RANKS not in state:
        whole = {**state, RANKS: ranks.gathered(state_tree.split(state)[0])}
        given = {"iteration": iteration, "config": config, "keep": keep, "trusted": trusted}
        return Path(ranks.by_first(lambda: str(save(folder, whole, **given))))
    folder.mkdir(exist_ok=True)
    tensors, values = state_tree.split(state)
    # In memory first: the hash is of exactly the bytes that are written.
    tensor_bytes = safetensors.torch.save(tensors)
    manifest_bytes = _seal(
        {
            "format_version": checkpoint_formats.FORMAT_VERSION,
            "iteration": iteration,
            "files": {TENSORS: {"bytes": len(tensor_bytes), "sha256": _sha256(tensor_bytes)}},
            "values": values,
            "config": dict(config),
        }
    )

    # Never over an older checkpoint: a resumed run may reach the same iteration again.
    name = _unused_name(folder, iteration)
    temporary = folder / f"{WRITING}{name}"
    try:
        temporary.mkdir()
        _write_durably(temporary / TENSORS, tensor_bytes)
        _write_durably(temporary / MANIFEST, manifest_bytes)
        _flush_folder(temporary)
        # Atomic on one file system: the valid name appears with whole content or not at all.
        os.replace(temporary, folder / name)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        with suppress(OSError):
            folder.rmdir()  # only where no checkpoint is in it yet
        raise
    # The new name must be on disk before an older checkpoint goes.
    _flush_folder(folder)

    # Drop old ones, but for the newest that is known to be right.
    last_trusted = newest_until(folder, iteration if trusted is None else trusted)
    for old in saved(folder)[:-keep]:
        if old == last_trusted:
            continue
        discarded = folder / f"{_DISCARDED}{old.name}"
        # Renamed first, so that a crash while deleting leaves no half checkpoint under a valid name.
        os.replace(old, discarded)
        shutil.rmtree(discarded)
    return folder / name


def own_part(state: State, live: Callable[[], State]) -> State:
    """Return this rank's part of a checkpoint's state; `live` returns the state of the run that loads it."""
    if RANKS not in state and ranks.size() == 1:
        return state
    tensors, values = state_tree.split(
        {name: part for name, part in state.items() if name != RANKS}
    )
    of_ranks = state_tree.branch(state, RANKS) if RANKS in state else None
    here, _ = state_tree.split(live())
    return state_tree.join(ranks.dealt(tensors, of_ranks, here), values)


def load(path: Path) -> Checkpoint:
    """Read a checkpoint of any format, every byte verified first; a CheckpointError says what is damaged or unknown."""
    manifest = _read_manifest(path)
    files = manifest["files"]
    # An extra file is refused: it could be anything, and its hash is nowhere.
    surplus = {entry.name for entry in path.iterdir()} - {MANIFEST, *files}
    if surplus:
        raise CheckpointError(
            f"{path}: unexpected file {sorted(surplus)[0]!r}; a checkpoint holds only its own"
        )
    # The limit keeps a forged manifest from filling the memory.
    tensor_bytes = _read_regular_file(
        path / TENSORS, limit=min(files[TENSORS]["bytes"], MOST_TENSOR_BYTES)
    )
    # Size before hash, as it tells a truncated copy apart from other damage.
    if len(tensor_bytes) != files[TENSORS]["bytes"]:
        raise CheckpointError(
            f"{path / TENSORS}: damaged: {len(tensor_bytes)} bytes, the manifest says {files[TENSORS]['bytes']}"
        )
    if _sha256(tensor_bytes) != files[TENSORS]["sha256"]:
        raise CheckpointError(f"{path / TENSORS}: damaged: its SHA-256 is not the manifest's")
    try:
        with fitting(path):
            state = state_tree.join(safetensors.torch.load(tensor_bytes), manifest["values"])
    except (SafetensorError, ValueError) as error:
        raise CheckpointError(f"{path / TENSORS}: not a valid tensor file: {error}") from error
    with fitting(path):
        # Only after all bytes are verified is an older format brought up to date.
        state, config = checkpoint_formats.migrate(
            state, manifest["config"], version=manifest["format_version"]
        )
    return Checkpoint(path=path, iteration=manifest["iteration"], config=config, state=state)


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Turn errors about missing parts or wrong types in a checkpoint's state into a CheckpointError.

    A manifest with a right hash may hold anything: hashes have no key.
    """
    try:
        yield
    except MISFITS as error:
        what = f"{type(error).__name__}: {error}"
        raise CheckpointError(
            f"{path}: it holds another state than such a run has: {what}"
        ) from error


def saved(folder: Path) -> list[Path]:
    """Return the checkpoints in `folder`, oldest first."""
    if not folder.is_dir():
        return []
    found = [
        entry for entry in folder.iterdir() if _order(entry.name) is not None and entry.is_dir()
    ]
    return sorted(found, key=lambda entry: _order(entry.name) or (0, 0))


def newest_until(folder: Path, iteration: int) -> Path | None:
    """Return the newest checkpoint in `folder` of this iteration or an earlier one, None without such."""
    newest = None
    # In the order of their iterations.
    for entry in saved(folder):
        order = _order(entry.name)
        if order is None or order[0] <= iteration:
            newest = entry
    return newest


def load_latest(path: Path, *, note: Callable[[str], None] = warnings.warn) -> Checkpoint:
    """Read the newest whole checkpoint of a run folder or a checkpoint folder, or the one that `path` is.

    A `note` says which damaged ones are passed over, and which one is taken. Where all are damaged, or the newest is of
    an unknown format, the error is about the newest.
    """
    if (path / MANIFEST).exists():
        return load(path)
    damage: list[CheckpointError] = []
    # Newest first, in a run folder or in its folder of checkpoints.
    for candidate in reversed(saved(path / "checkpoint") or saved(path)):
        try:
            found = load(candidate)
        # An older checkpoint would be taken in silence otherwise, and the run would lose iterations.
        except UnknownFormatError:
            raise
        except CheckpointError as error:
            damage.append(error)
        else:
            if damage:
                passed = "; ".join(map(str, damage))
                note(f"{passed}: passed over, the checkpoint {candidate.name} is taken instead")
            return found
    if damage:
        raise damage[0]
    raise CheckpointError(
        f"{path}: no checkpoint here; expected a run folder, its checkpoint/ or one of those in it"
    )


def remove_leftovers(folder: Path) -> None:
    """Delete leftovers of a crash while writing or deleting."""
    for entry in folder.iterdir() if folder.is_dir() else ():
        if entry.name.startswith((WRITING, _DISCARDED)):
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def columns_of(state: State) -> Columns:
    """Return the columns of the observations that a checkpoint's networks read: group -> term -> range."""
    saved = state_tree.branch(state, "observation_columns")
    columns: dict[str, dict[str, Sequence[int]]] = {}
    for group in saved:
        terms = state_tree.branch(saved, group)
        columns[group] = {name: _range_of(name, found) for name, found in terms.items()}
    return columns


def _range_of(name: str, found: state_tree.Value) -> list[int]:
    if isinstance(found, Sequence) and len(found) == 2:
        ends = [end for end in found if isinstance(end, int)]
        if len(ends) == 2:
            return ends
    raise ValueError(
        f"observation_columns: {name!r} is {found!r}: expected a first and a last column"
    )


def check_columns(saved: Columns, own: Columns) -> None:
    """Refuse, by name, terms or columns other than the checkpoint's; both are group -> term -> range."""
    faults = []
    for group in dict.fromkeys([*saved, *own]):
        theirs = saved.get(group, {})
        ours = own.get(group, {})
        surplus = [n for n in theirs if n not in ours]
        missing = [n for n in ours if n not in theirs]
        moved = [name for name in theirs if name in ours and list(theirs[name]) != list(ours[name])]
        if surplus:
            faults.append(f"group {group!r}: only the checkpoint has {', '.join(surplus)}")
        if missing:
            faults.append(f"group {group!r}: only this run has {', '.join(missing)}")
        # A missing term moves all others, so moves are only told on their own.
        if moved and not surplus and not missing:
            places = ", ".join(f"{n} at {list(theirs[n])}, here {list(ours[n])}" for n in moved)
            faults.append(f"group {group!r}: the checkpoint has {places}")
    if faults:
        raise ValueError(f"the checkpoint is of other observations: {'; '.join(faults)}")


def _seal(manifest: Tree) -> bytes:
    # Not sorted: the order of observation terms in the config is the order of the networks' inputs.
    body = json.dumps(manifest, allow_nan=False, separators=(",", ":"))
    return f'{{"manifest_sha256":"{_sha256(body.encode())}",\n"manifest":{body}}}\n'.encode()


def _read_manifest(path: Path) -> Tree:
    if not path.is_dir():
        raise CheckpointError(f"{path}: no such checkpoint folder")
    raw = _read_regular_file(path / MANIFEST, limit=_MAX_MANIFEST_BYTES)
    try:
        manifest = json.loads(raw)["manifest"]
        # Sealed again and compared byte by byte, so there is only one spelling of a manifest.
        intact = _seal(manifest) == raw
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(
            f"{path / MANIFEST}: damaged: {type(error).__name__}: {error}"
        ) from error
    if not intact:
        raise CheckpointError(f"{path / MANIFEST}: damaged: its SHA-256 does not match its content")
    if isinstance(manifest, dict):
        version = manifest.get("format_version")
    else:
        version = None
    # After the hash and before the fields, which other formats may have otherwise.
    if reason := checkpoint_formats.refusal(version):
        raise UnknownFormatError(f"{path}: {reason}")
    files = manifest.get("files")
    if isinstance(files, dict) and len(files) == 1:
        of_tensors = files.get(TENSORS)
    else:
        of_tensors = None
    if not (
        _has(manifest, iteration=int, config=dict, values=dict)
        and _has(of_tensors, bytes=int, sha256=str)
    ):
        raise CheckpointError(
            f"{path / MANIFEST}: not a checkpoint manifest: a field is missing or of another type"
        )
    return manifest


def _has(tree: Plain, **kinds: type) -> bool:
    if not isinstance(tree, dict):
        return False
    # A truth value is a whole number in Python.
    found = {name: tree.get(name) for name in kinds}
    return all(
        isinstance(found[name], kind) and not isinstance(found[name], bool)
        for name, kind in kinds.items()
    )


def _read_regular_file(path: Path, *, limit: int) -> bytes:
    try:
        return read_bytes(path, limit=limit)
    except ValueError as error:
        raise CheckpointError(str(error)) from error


def _write_durably(path: Path, content: bytes) -> None:
    with open(path, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _order(name: str) -> tuple[int, int] | None:
    # Names are "<iteration>" or "<iteration>_<repeat>"; anything else is no checkpoint.
    number, _, repeat = name.partition("_")
    if number.isdecimal() and (not repeat or repeat.isdecimal()):
        return int(number), int(repeat or 0)
    return None


def _unused_name(folder: Path, iteration: int) -> str:
    name = f"{iteration:08d}"
    repeat = 0
    while (folder / name).exists():
        repeat += 1
        name = f"{iteration:08d}_{repeat}"
    return name


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
