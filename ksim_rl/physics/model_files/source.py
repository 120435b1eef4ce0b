"""Reads the text of a model from its name: a path, an XML text or a menagerie name."""

import re
from dataclasses import dataclass
from pathlib import Path

from ksim_rl.checks import naming
from ksim_rl.files.reading import MOST_MODEL_BYTES, read_bytes
from ksim_rl.files.xml_text import decode_xml
from ksim_rl.physics.model_files.menagerie import model_path

SUFFIXES = (".xml", ".mjcf", ".urdf")
"""In small or capital letters."""
_MENAGERIE_NAME = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)?")


@dataclass(frozen=True, kw_only=True)
class ModelText:
    """The text of a model, its file (None for an XML string), and how messages call it."""

    path: Path | None
    text: str
    label: str

    @property
    def folder(self) -> Path:
        """Where the files that it names are looked for."""
        if self.path:
            return self.path.parent
        return Path()


def is_xml(source: str | Path) -> bool:
    """Return whether a source is the text of a model itself."""
    return isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<")


def model_file(source: str | Path) -> Path | None:
    """Return the path that a source names, with `~` for the home folder; None for an XML string.

    A ValueError says that there is no such file, or that its suffix is none of a model's.
    """
    if isinstance(source, str):
        if not source.strip():
            raise ValueError(
                "model source is an empty string: expected a path, an XML string or a menagerie name"
            )
        if is_xml(source):
            return None
        if _MENAGERIE_NAME.fullmatch(source) and not Path(source).exists():
            source = model_path(source)
    path = Path(source)
    try:
        path = path.expanduser()
    except RuntimeError as error:  # a user who is not known
        raise ValueError(f"model file {str(path)!r}: {error}") from None
    if path.is_dir() or not path.exists():
        raise ValueError(
            f"model file {str(path)!r}: {'is a folder' if path.is_dir() else 'no such file'}"
        )
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"model file {str(path)!r}: expected a name that ends in {', '.join(SUFFIXES)}"
        )
    return path


def read_source(source: str | Path) -> ModelText:
    """Read a model's text, of a file in the encoding that it declares; a ValueError names the file."""
    path = model_file(source)
    if path is None:
        return ModelText(path=None, text=str(source).lstrip("\ufeff"), label="XML string")
    with naming("model file"):
        data = read_bytes(path, limit=MOST_MODEL_BYTES, follows_links=True)
    with naming(f"model file {str(path)!r}"):
        text = decode_xml(data)
    if not text.strip():
        raise ValueError(f"model file {str(path)!r} is empty")
    return ModelText(path=path, text=text, label=str(path))
