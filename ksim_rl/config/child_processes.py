"""Starts every process that the library starts: Python children, and git.

Python puts the working directory first on the path of `python -m` and `python -c`. A user who stands in a stranger's
folder would run the `mujoco.py` that lies there. So a child is started with `-P`, in a folder that no stranger writes,
and finds plug-ins by the absolute paths of their folders. One that reads files which a config names by relative paths
goes where its parent stands, by `go_to_parents_folder`, once its modules are imported.
"""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ksim_rl.config import plugins

# The top of the file system, which only the machine's administrator changes.
START = "/"
_GIT_SECONDS = 20
_PARENTS_FOLDER = "KSIM_RL_PARENTS_FOLDER"


def start_python(
    words: Sequence[str], *, environment: Mapping[str, str] | None = None, **streams: Any
) -> "subprocess.Popen[Any]":
    """Start Python with `words` behind its own flags, such as `["-m", "ksim_rl.tables.measure"]`.

    `environment` replaces variables of this process, and `streams` go to `subprocess.Popen`.
    """
    # Plug-ins of this process by absolute paths, as the child starts elsewhere.
    own = plugins.environment()
    with suppress(OSError):  # the folder may be gone, and most children need none
        own[_PARENTS_FOLDER] = os.getcwd()
    return subprocess.Popen(
        # -P: a file such as json.py in the working directory would change the child's imports.
        [sys.executable, "-P", *words],
        env={**os.environ, **own, **(environment or {})},
        cwd=START,
        **streams,
    )


def run_python(
    words: Sequence[str],
    *,
    environment: Mapping[str, str] | None = None,
    text: str | None = None,
    seconds: float | None = None,
) -> "subprocess.CompletedProcess[str]":
    """Run Python as `start_python` does, with `text` as its input, and return its exit code and its output.

    A child that takes longer than `seconds` is killed, and `subprocess.TimeoutExpired` is raised.
    """
    pipes: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with start_python(words, environment=environment, text=True, **pipes) as child:
        try:
            printed, complaints = child.communicate(text, timeout=seconds)
        # Also for Ctrl-C: no child goes on without us.
        except BaseException:
            child.kill()
            raise
    return subprocess.CompletedProcess(child.args, child.returncode, printed, complaints)


def go_to_parents_folder() -> None:
    """Enter the working directory of the process that started this one, where relative paths of a config begin."""
    # Taken out, so that children of the child do not follow it.
    folder = os.environ.pop(_PARENTS_FOLDER, None)
    if folder is not None:
        os.chdir(folder)


def ask_git(folder: Path, *arguments: str) -> bytes | None:
    """Return git's output about a folder, or None where there is no git, or git has no answer."""
    # The folder may have settings that name programs; none of them is needed to list files and compare them.
    harmless = ("core.fsmonitor=false", "core.hooksPath=/dev/null", "core.quotePath=false")
    settings = [word for setting in harmless for word in ("-c", setting)]
    # Variables of git may name another repository, such as in a hook.
    own = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    command = ["git", *settings, "-C", str(folder.absolute()), *arguments]
    try:
        done = subprocess.run(
            command, capture_output=True, check=True, timeout=_GIT_SECONDS, env=own, cwd=START
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout
