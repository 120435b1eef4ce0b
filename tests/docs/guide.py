"""Reads the files and code that a guide shows, so that tests can follow it to the letter."""

import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def files(name: str) -> dict[str, str]:
    """Return the files that a guide has the reader write, by path: the blocks under `<!-- file: path -->`."""
    found = re.findall(r"<!-- file: (\S+) -->\n```\w*\n(.*?)```", (DOCS / name).read_text(), re.DOTALL)
    assert found, f"{name} shows no files"
    return dict(found)


def write_files(name: str, folder: Path) -> None:
    """Write them."""
    for path, text in files(name).items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
