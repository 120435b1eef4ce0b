"""Collects the files of a model, so that they can be kept elsewhere and compared."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from ksim_rl.files.reading import MOST_DATA_BYTES, read_bytes
from ksim_rl.physics.model_files.source import model_file, read_source
from ksim_rl.physics.model_files.urdf import is_urdf, packages_of, ready_urdf
from ksim_rl.physics.model_size import files_named


@dataclass(frozen=True, kw_only=True)
class ModelFiles:
    """All files of a model, by their paths below `folder`; `main` is the one to load.

    The folder is the one above that which holds all of them, so that paths between them, and names of ROS packages,
    stay as they are wherever it lies.
    """

    folder: Path
    main: str
    names: tuple[str, ...]

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum((self.folder / name).stat().st_size for name in self.names)

    def contents(self, name: str) -> bytes:
        """Read one of the files."""
        return read_bytes(self.folder / name, limit=MOST_DATA_BYTES, follows_links=True)

    def sha256(self) -> str:
        """Return the hash of all names and contents."""
        total = hashlib.sha256(self.main.encode())
        for name in self.names:
            of_file = hashlib.sha256(self.contents(name)).hexdigest()
            total.update(f"{name}\n{of_file}\n".encode())
        return total.hexdigest()


def files_of_model(source: str | Path) -> ModelFiles | None:
    """Return the files of a source of `load_spec`; None for an XML string. A ValueError says what cannot be read."""
    path = model_file(source)
    if path is None:
        return None
    read = read_source(path)
    text = read.text
    packages: list[Path] = []
    if is_urdf(text):
        packages = packages_of(text, read.folder)
        text = ready_urdf(text, read.folder)
    # Absolute, without resolving links: names in the texts are relative to the path as it is called.
    main = Path(os.path.abspath(path))
    paths = sorted({main, *files_named(text, read.folder, read.label)})
    # One folder higher, since packages of ROS are found by the names of folders above the file.
    folder = Path(os.path.commonpath([*(file.parent for file in paths), *packages])).parent
    return ModelFiles(
        folder=folder,
        main=str(main.relative_to(folder)),
        names=tuple(str(file.relative_to(folder)) for file in paths),
    )
