"""Finds what a user's own config files say, so that an error about it names the file."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

import yaml
from hydra.core.hydra_config import HydraConfig

from ksim_rl.checks import naming
from ksim_rl.conf.registration import MODULE
from ksim_rl.config.overrides import given_fields, leaves
from ksim_rl.envs.managers.replaced_fields import check_given
from ksim_rl.files.reading import MOST_CONFIG_BYTES, read_bytes
from ksim_rl.trainers import RunCfg

PACKAGE = "# @package"
NOT_OWN = (MODULE, "hydra.conf")


@dataclass(frozen=True, kw_only=True)
class OwnFile:
    """A config file of the user's, or of a plug-in, that the config of this job was composed of.

    Attributes:
        path: the file.
        fields: the fields that it gives values, by dotted path: "task.commands.twist.lin_vel_x".
    """

    path: str
    fields: tuple[str, ...]


def own_files() -> list[OwnFile]:
    """Return the config files of the job that Hydra runs, without the files of this package."""
    launched = HydraConfig.get()
    places: list[Traversable] = []
    for source in launched.runtime.config_sources:
        if source.schema == "file":
            places.append(Path(source.path))
        elif source.schema == "pkg" and source.path not in NOT_OWN:
            # Hydra itself warns of a package that is not there.
            with suppress(ModuleNotFoundError):
                places.append(files(source.path.replace("/", ".")))
    # The primary config, then the choice of each group: "group" or "group@package".
    wanted = [(str(launched.job.config_name), "")]
    for group, choice in launched.runtime.choices.items():
        name, _, package = str(group).partition("@")
        wanted.append((f"{name}/{choice}", package or name.replace("/", ".")))
    found = []
    for place in places:
        for name, package in wanted:
            path = Path(str(place / f"{name.removesuffix('.yaml')}.yaml"))
            # Groups have choices that are no files, too.
            if path.is_file():
                # Hydra has read it before.
                text = read_bytes(path, limit=MOST_CONFIG_BYTES, follows_links=True).decode()
                found.append(OwnFile(path=str(path), fields=tuple(_fields(text, package))))
    return found


def _fields(text: str, package: str) -> Iterator[str]:
    """Yield the fields of a file's text; its first comment may put them elsewhere than its group does."""
    for line in text.splitlines():
        if line.startswith(PACKAGE):
            package = line.removeprefix(PACKAGE).strip()
    # A group's own path is called so.
    prefix = package.replace("_global_", "").strip(".")
    tree = yaml.safe_load(text)
    if not isinstance(tree, dict):
        return
    for name, value in tree.items():
        if name != "defaults":
            yield from leaves(f"{prefix}.{name}".strip("."), value)


@contextmanager
def naming_files(own: Sequence[OwnFile]) -> Iterator[None]:
    """Put the file that gives a field in front of a ValueError about this field."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        for file in own:
            if any(_is_about(text, field) for field in file.fields):
                raise ValueError(f"{file.path}: {text}") from error
        raise


def _is_about(text: str, field: str) -> bool:
    """Tell whether an error names a field, or the mapping that holds it."""
    parts = field.split(".")
    # At least two words: "task" alone is in too many messages.
    paths = [".".join(parts[:end]) for end in range(len(parts), 1, -1)]
    return any(f"'{path}'" in text or text.startswith((f"{path}=", f"{path}:")) for path in paths)


def check_files_not_replaced(cfg: RunCfg, own: Sequence[OwnFile], overrides: Sequence[str]) -> None:
    """Refuse files that give a field a value which a curriculum replaces, unless they give the curriculum values too.

    Args:
        cfg: the composed config.
        own: its files.
        overrides: of the command line, which may be of the curriculum as well.

    Raises:
        ValueError: naming the file, the field and the curriculum.
    """
    besides = [*given_fields(overrides)]
    for file in own:
        besides += file.fields
    for file in own:
        with naming(file.path):
            check_given(cfg.task.curriculum, file.fields, besides)
