"""Checks that each C++ header of a kernel compiles on its own, with the g++ or clang++ of this machine.

    python -m tests.headers              # a part of `make check`
    python -m tests.headers --commands   # writes compile_commands.json, with which clangd knows the headers

A compiler sees what the CPU would run; what only a GPU does is compiled by `tests.cuda_builds`.
"""

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import warp as wp

from ksim_rl.terminal import show
from tests.docs.guide import REPOSITORY

COMPILERS = ("g++", "clang++")
FILE = "compile_commands.json"


def command(header: Path, compiler: str, root: Path = REPOSITORY) -> list[str]:
    """Return the command that checks a header, in which paths of includes begin at `root`."""
    of_warp = Path(wp.__file__).parent / "native"
    # Of `#pragma once` in the main file, and pragmas of CUDA, compilers warn.
    flags = ["-std=c++17", "-fsyntax-only", "-w", "-xc++"]
    return [compiler, *flags, f"-I{root}", f"-isystem{of_warp}", str(header)]


def errors_of(header: Path, compiler: str, root: Path = REPOSITORY) -> str:
    """Return what a compiler says of a header; nothing where it compiles."""
    done = subprocess.run(command(header, compiler, root), capture_output=True, text=True)
    return done.stderr if done.returncode else ""


def headers(root: Path = REPOSITORY) -> list[Path]:
    """Return all headers of the package."""
    return sorted((root / "ksim_rl").rglob("*.cuh"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Check all headers, or write the commands."""
    parser = argparse.ArgumentParser(description="Check the headers of kernels.")
    parser.add_argument("--commands", action="store_true", help=f"write {FILE} instead")
    found = headers()
    if parser.parse_args(arguments).commands:
        commands = [
            {
                "directory": str(REPOSITORY),
                "file": str(header),
                "arguments": command(header, COMPILERS[-1]),
            }
            for header in found
        ]
        (REPOSITORY / FILE).write_text(json.dumps(commands, indent=2))
        show(f"{FILE}: {len(found)} headers")
        return
    compiler = next((name for name in COMPILERS if shutil.which(name)), None)
    if compiler is None:
        show(f"headers: not checked, since there is neither {' nor '.join(COMPILERS)}")
        return
    with ThreadPoolExecutor(2) as pool:
        errors = list(pool.map(lambda header: errors_of(header, compiler), found))
    for text in filter(None, errors):
        show(text, to_stderr=True)
    if any(errors):
        sys.exit(1)
    show(f"headers: {len(found)} compile with {compiler}")


if __name__ == "__main__":
    main()
