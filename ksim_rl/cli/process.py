"""Refuses, before libraries are loaded, a process in which they would crash."""

import os
import resource
import sys

# Least bytes of a resource with which the smallest task trains on a CPU, and how a shell limits it. Libraries in C
# abort the process where there is less, which no handler can catch.
_LEAST = (
    (resource.RLIMIT_AS, "address space", "ulimit -v", 2 * 2**30),
    (resource.RLIMIT_DATA, "memory", "ulimit -d", 2**30),
    (resource.RLIMIT_STACK, "stack", "ulimit -s", 2**20),
)


def check_process() -> None:
    """Refuse limits under which libraries abort, a Python without docstrings, and a working directory that is gone."""
    # TorchRL puts texts of docstrings together as it is imported.
    if sys.flags.optimize >= 2:
        raise ValueError(
            "Python runs without docstrings, which libraries need: unset PYTHONOPTIMIZE, or start it without -OO"
        )
    for kind, name, command, least in _LEAST:
        most, _ = resource.getrlimit(kind)
        if most != resource.RLIM_INFINITY and most < least:
            raise ValueError(
                f"the {name} of this process is limited to {most / 2**20:.3g} MiB ({command}), in which libraries "
                f"crash: raise it to {least / 2**20:g} MiB or more, or to `unlimited`"
            )
    try:
        os.getcwd()
    except OSError as error:
        raise ValueError(
            f"the working directory cannot be read ({error.strerror}): change to another one"
        ) from error
