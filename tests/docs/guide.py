"""Reads the files and code that a guide shows, so that tests can follow it to the letter."""

import os
import re
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
DOCS = REPOSITORY / "docs"


def files(name: str) -> dict[str, str]:
    """Return the files that a guide has the reader write, by path: the blocks under `<!-- file: path -->`."""
    found = re.findall(
        r"<!-- file: (\S+) -->\n```\w*\n(.*?)```", (DOCS / name).read_text(), re.DOTALL
    )
    assert found, f"{name} shows no files"
    return dict(found)


def write_files(name: str, folder: Path) -> None:
    """Write them."""
    for path, text in files(name).items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)


def install(folder: Path, site: Path) -> None:
    """Install the package in `folder` into `site`, where only `run` sees it."""
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
    ]
    subprocess.run([*pip, "--upgrade", "--target", site, folder], check=True)


def run(*command: str | Path, site: Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run Python with what is installed in `site`."""
    paths = os.pathsep.join([str(site), str(REPOSITORY)])
    return subprocess.run(
        [sys.executable, *command],
        capture_output=True,
        text=True,
        check=False,
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": paths, "COLUMNS": "150"},
    )
