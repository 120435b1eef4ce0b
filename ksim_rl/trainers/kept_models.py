"""Keeps the model files of a run with their hashes, and tells a resumed run where a file has changed since.

`models.json` of a run folder says of each robot and object whose model is a file: its path, the hash of all its files,
and where in the folder `models` a copy lies. Models of the menagerie, and models that are too large, have only a hash,
and so do files of data: motions, sets of them, and networks of motors.
"""

import dataclasses
import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ksim_rl.checked import parts
from ksim_rl.config.trees import Plain
from ksim_rl.files.reading import MOST_TEXT_BYTES, read_bytes
from ksim_rl.files.writing import check_links, whole_folder, write_whole
from ksim_rl.physics.model_files.packing import ModelFiles, files_of_model
from ksim_rl.physics.model_files.source import is_xml
from ksim_rl.scene.motions.contents import sha256_of
from ksim_rl.scene.motions.motion import motion_path
from ksim_rl.scene.motions.motion_set import MotionSet
from ksim_rl.scene.robots.legged_robot import MenagerieRobot, ModelRobot
from ksim_rl.scene.scene import MjcfRobot
from ksim_rl.terminal import printable
from ksim_rl.trainers.run_cfg import RunCfg

FOLDER = "models"
RECORD = "models.json"
MOST_KEPT_BYTES = 64 * 2**20
"""Size up to which a run keeps a copy of a model, with its meshes and textures."""
KINDS = ("robots", "objects")


class AbsolutePathError(ValueError):
    """Raised for a model whose copy would still read files of another place."""


@dataclass(frozen=True, kw_only=True)
class KeptModel:
    """A run's record of a model: the path it was read from, its hash, and its copy's path below `models`, if any."""

    source: str
    sha256: str
    copy: str = ""


def keep_models(cfg: RunCfg, run_folder: Path, *, note: Callable[[str], None]) -> None:
    """Write the models of a config's robots and objects into a run folder, but for those that are there already.

    Of files of data their hashes are written.
    """
    earlier = read_record(run_folder)
    record: dict[str, KeptModel] = {}
    for name, source in _sources(cfg):
        known = earlier.get(name)
        # The record is of the run's beginning: a resumed run must not replace it by a changed file.
        if known is not None and (source == known.source or _is_copy(source, known)):
            record[name] = known
            continue
        files = files_of_model(source)
        # A model that is built in code has no files.
        if files is not None:
            record[name] = _keep(name, source, files, run_folder, note)
    for data in _data(cfg):
        known = earlier.get(data.name)
        if known is not None and data.source == known.source:
            record[data.name] = known
        else:
            record[data.name] = KeptModel(source=data.source, sha256=data.sha256())
    # An unchanged record is not written again.
    if record != earlier:
        plain = {name: dataclasses.asdict(kept) for name, kept in record.items()}
        write_whole(run_folder / RECORD, json.dumps(plain, indent=2) + "\n")


@dataclass(frozen=True, kw_only=True)
class ReadFile:
    """A model or data that a config reads.

    Models of the menagerie and motions of the package are the same for all who have these.

    Attributes:
        name: its name in `models.json`.
        is_own: whether it lies in a folder of the user's.
        sha256: returns its hash; a ValueError says why it cannot be read.
    """

    name: str
    is_own: bool
    sha256: Callable[[], str]


def files_read(cfg: RunCfg) -> Iterator[ReadFile]:
    """Yield the models and the files of data that a config reads."""
    for name, source in _sources(cfg):
        yield ReadFile(
            name=name, is_own=_is_own_model(source), sha256=partial(_sha256_of_model, source)
        )
    for data in _data(cfg):
        yield ReadFile(name=data.name, is_own=data.is_own, sha256=data.sha256)


def with_kept_models(
    cfg: RunCfg, run_folder: Path, *, note: Callable[[str], None] | None = None
) -> RunCfg:
    """Return a run's config with the models that it began with.

    Where a model's file is not there any more, or has changed, the run's own copy takes its place, and `note` (by
    default a warning) says so. Where there is no copy, a changed file is warned of by name, as is changed data.
    """
    note = note or _warn
    # By "robots/NAME" or "objects/NAME".
    record = read_record(run_folder)
    scene = cfg.task.scene
    changed: dict[str, dict[str, Any]] = {kind: dict(getattr(scene, kind)) for kind in KINDS}
    for name, source in _sources(cfg):
        kept = record.get(name)
        kind, _, entity = name.partition("/")
        if kept is None:
            continue  # a run of before there were copies
        if _is_copy(source, kept):  # of a run that went on with its copy, and may lie elsewhere now
            changed[kind][entity] = _with_source(
                changed[kind][entity], str(_checked_copy(name, kept, run_folder))
            )
            continue
        # Such as by an override on the command line.
        if source != kept.source:
            continue  # another model, which was asked for
        why = _difference(source, kept)
        if not why:
            continue
        if not kept.copy:
            note(
                f"task.scene.{kind}.{entity}: {why}, and the run kept its hash alone: its policy may not fit any more"
            )
            continue
        copy = _checked_copy(name, kept, run_folder)
        note(f"task.scene.{kind}.{entity}: {why}: the run's own copy is used, {copy}")
        changed[kind][entity] = _with_source(changed[kind][entity], str(copy))
    for data in _data(cfg):
        kept = record.get(data.name)
        # Of other sources the user knows.
        if kept is None or data.source != kept.source or data.sha256() == kept.sha256:
            continue
        note(f"{data.where}: {data.change}")
    scene = dataclasses.replace(scene, **changed)
    return dataclasses.replace(cfg, task=dataclasses.replace(cfg.task, scene=scene))


def read_record(run_folder: Path) -> dict[str, KeptModel]:
    """Return a run's record of its models, empty for a run that kept none; a ValueError for a file of another kind."""
    path = run_folder / RECORD
    if not os.path.lexists(path):
        return {}
    try:
        plain = _dictionary(json.loads(read_bytes(path, limit=MOST_TEXT_BYTES)))
        return {str(name): KeptModel(**_texts(entry)) for name, entry in plain.items()}
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: no record of a run's models: {printable(str(error))}") from error


def _keep(
    name: str, source: str, files: ModelFiles, run_folder: Path, note: Callable[[str], None]
) -> KeptModel:
    kept = KeptModel(source=source, sha256=files.sha256())
    if not Path(source).expanduser().is_file():  # a name of the menagerie, which others have too
        return kept
    if files.size > MOST_KEPT_BYTES:
        note(
            f"task.scene.{name.replace('/', '.')}: {files.size / 2**20:.0f} MiB of model: the run keeps only "
            f"the hash (copies end at {MOST_KEPT_BYTES // 2**20} MiB)"
        )
        return kept
    place = name.replace("/", "_")
    try:
        with whole_folder(run_folder / FOLDER / place, below=run_folder) as unfinished:
            # The same folders as in the source, since models name meshes by relative paths.
            for file in files.names:
                (unfinished / file).parent.mkdir(parents=True, exist_ok=True)
                write_whole(unfinished / file, files.contents(file))
            # A copy with another hash still refers to files elsewhere.
            if not _is_whole(unfinished / files.main, kept):
                raise AbsolutePathError(f"{source} names files by absolute paths")
    except AbsolutePathError as error:
        note(f"task.scene.{name.replace('/', '.')}: {error}: the run keeps only its hash")
        return kept
    return dataclasses.replace(kept, copy=f"{place}/{files.main}")


def _is_whole(copy: Path, kept: KeptModel) -> bool:
    """Return whether a copy finds all files of the model next to it, and only these."""
    try:
        files = files_of_model(copy)
    except ValueError:
        return False
    return files is not None and files.sha256() == kept.sha256


def _difference(source: str, kept: KeptModel) -> str:
    """Return how the files of a model differ from the start of the run; nothing if they do not."""
    try:
        files = files_of_model(source)
    except ValueError as error:
        return str(error)
    if files is None or files.sha256() == kept.sha256:
        return ""
    return f"{source} has changed since the run began"


def _is_copy(source: str, kept: KeptModel) -> bool:
    """Return whether a path leads to a run's copy of a model, wherever the run's folder lay."""
    return bool(kept.copy) and source.endswith(f"/{FOLDER}/{kept.copy}")


def _checked_copy(name: str, kept: KeptModel, run_folder: Path) -> Path:
    """Return the path of a run's copy of a model; a ValueError refuses one that is damaged, or reaches outside."""
    # A run folder may come from another user: links and ".." must not lead out of it.
    check_links(run_folder, below=(FOLDER,))
    inside = (run_folder / FOLDER).resolve()
    path = Path(os.path.abspath(run_folder / FOLDER / kept.copy))
    files = files_of_model(path)
    assert files is not None
    for file in files.names:
        if not (files.folder / file).resolve().is_relative_to(inside):
            raise ValueError(
                f"{path}: the run's copy of {name} names {files.folder / file}, which lies outside of it"
            )
    # Last, when all files are known to lie inside.
    if files.sha256() != kept.sha256:
        raise ValueError(
            f"{path}: damaged: not the model of {name} that the run began with, by its hash in {RECORD}"
        )
    return path


def _sources(cfg: RunCfg) -> Iterator[tuple[str, str]]:
    """Yield the models of a config that are files or names: "robots/NAME" or "objects/NAME", and the source."""
    for kind in KINDS:
        for name, entity in getattr(cfg.task.scene, kind).items():
            if isinstance(entity, MjcfRobot):
                yield f"{kind}/{name}", entity.source
            elif isinstance(entity, MenagerieRobot):
                yield f"{kind}/{name}", entity.model


@dataclass(frozen=True, kw_only=True)
class _Data:
    """Data that a config names: its place in the record and in the config, and how a change of it is reported."""

    name: str
    where: str
    source: str
    change: str
    is_own: bool
    sha256: Callable[[], str]


def _data(cfg: RunCfg) -> Iterator[_Data]:
    """Yield the sets of motions of a config, "motions/NAME", then its other files of data, "files/SOURCE"."""
    sets = cfg.task.scene.motions
    for name, motions in sets.items():
        source = ", ".join(motions.sources)
        yield _Data(
            name=f"motions/{name}",
            where=f"task.scene.motions.{name}",
            source=source,
            change=f"the motions of {source} have changed since the run began: other clips may be held out than in "
            "its training",
            is_own=any(map(_is_own, motions.sources)),
            sha256=motions.sha256,
        )
    told: set[str] = set()
    for where, part in parts(cfg):
        for source in part.data_files():
            path = motion_path(source)
            # A file that is not there is refused by who reads it.
            if source in sets or source in told or not path.exists():
                continue
            if path.is_dir():
                sha256 = MotionSet(sources=(source,)).sha256
            else:
                sha256 = partial(sha256_of, path)
            told.add(source)
            yield _Data(
                name=f"files/{source}",
                where=where,
                source=source,
                change=f"{source} has changed since the run began: its policy may not fit any more",
                is_own=_is_own(source),
                sha256=sha256,
            )


def _sha256_of_model(source: str) -> str:
    """Return the hash of a model's files; of one that is text, the text's."""
    files = files_of_model(source)
    if files is None:
        return hashlib.sha256(source.encode()).hexdigest()
    return files.sha256()


def _is_own_model(source: str) -> bool:
    """Return whether a model is a file, and no text and no name of the menagerie, which has no suffix."""
    if is_xml(source):
        return False
    return Path(source).suffix != "" or os.path.exists(os.path.expanduser(source))


def _is_own(source: str) -> bool:
    """Return whether a file of data is none of the package's."""
    return motion_path(source) == Path(source)


def _with_source(entity: MjcfRobot | MenagerieRobot, source: str) -> MjcfRobot | ModelRobot:
    if isinstance(entity, MjcfRobot):
        return dataclasses.replace(entity, source=source)
    # Others name a model of the menagerie; no copy of it is kept.
    assert isinstance(entity, ModelRobot)
    return dataclasses.replace(entity, model=source)


def _dictionary(plain: Plain) -> dict[str, Plain]:
    if not isinstance(plain, dict):
        raise ValueError("expected a mapping")
    return plain


def _texts(entry: Any) -> dict[str, str]:
    if not all(isinstance(value, str) for value in _dictionary(entry).values()):
        raise ValueError("expected texts")
    return entry


def _warn(text: str) -> None:
    warnings.warn(text, UserWarning, stacklevel=3)
