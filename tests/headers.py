"""Checks that each C++ header of a kernel compiles on its own, with the g++ or clang++ of this machine.

    python -m tests.headers              # a part of `make check`
    python -m tests.headers --commands   # writes compile_commands.json, with which clangd knows the headers

A compiler sees what the CPU would run; what only a GPU does is compiled by `tests.cuda_builds`.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import warp as wp

from ksim_rl.terminal import show
from tests.docs.guide import REPOSITORY

COMPILERS = ("g++", "clang++")
FILE = "compile_commands.json"
OF_WARP = Path(wp.__file__).parent / "native"
BUILTIN = "builtin.h"
# An include, before which a header has comments and its `#pragma once` alone.
_BEGINS_WITH = re.compile(r'(?:\s*(?://[^\n]*|#pragma once)\n)*\s*#include "([^"]+)"\n')


def command(header: Path, compiler: str, root: Path = REPOSITORY) -> list[str]:
    """Return the command that checks a header, in which paths of includes begin at `root`."""
    # Of `#pragma once` in the main file, and pragmas of CUDA, compilers warn.
    flags = ["-std=c++17", "-fsyntax-only", "-w", "-xc++"]
    return [compiler, *flags, f"-I{root}", f"-isystem{OF_WARP}", str(header)]


def begins_with_builtin(header: Path, root: Path = REPOSITORY) -> bool:
    """Whether a compiler reads Warp's header before all code of this one."""
    found = _BEGINS_WITH.match(header.read_text())
    if found is None:
        return False
    included = found[1]
    if included == BUILTIN:
        return True
    return (root / included).is_file() and begins_with_builtin(root / included, root)


def precompile_builtin(folder: Path) -> Path | None:
    """Let g++ read Warp's header once, which is nine tenths of each check; returns the path to include, or none."""
    # A name of its own: an include of builtin.h has to find Warp's.
    prefix = folder / "precompiled.h"
    flags = ["-std=c++17", "-w", "-xc++-header", f"-isystem{OF_WARP}"]
    made = [COMPILERS[0], *flags, str(OF_WARP / BUILTIN), "-o", f"{prefix}.gch"]
    return None if subprocess.run(made, capture_output=True).returncode else prefix


def errors_of(
    header: Path, compiler: str, root: Path = REPOSITORY, precompiled: Path | None = None
) -> str:
    """Return what a compiler says of a header; nothing where it compiles.

    `precompiled` takes the place of Warp's header where a compiler would read that first.
    """
    checked = command(header, compiler, root)
    if precompiled is not None and begins_with_builtin(header, root):
        checked += ["-include", str(precompiled)]
    done = subprocess.run(checked, capture_output=True, text=True)
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
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(2) as pool:
        precompiled = None
        if compiler == COMPILERS[0]:
            precompiled = precompile_builtin(Path(folder))
        checks = [
            pool.submit(errors_of, header, compiler, precompiled=precompiled) for header in found
        ]
        errors = [check.result() for check in checks]
    for text in filter(None, errors):
        show(text, to_stderr=True)
    if any(errors):
        sys.exit(1)
    show(f"headers: {len(found)} compile with {compiler}")


if __name__ == "__main__":
    main()
