"""Finds the caches of compilers, and explains errors of theirs: a full disk or a crash may have left files cut.

Torch's compiler and Triton take what lies in their caches as it is, and what they raise then names neither the cache
nor a way out. Warp's cache is mended by `kernel_cache.py`.
"""

import getpass
import os
import tempfile
import traceback
from dataclasses import dataclass
from pathlib import Path

# Modules in which torch 2.10 to 2.14 and Triton 3.6 and 3.7 compile, or read what was compiled. What is raised while
# compiled code runs, such as for want of memory, does not pass through them.
_COMPILERS = (
    "torch._inductor.compile_fx",
    "torch._inductor.codecache",
    "triton.compiler",
    "triton.runtime.cache",
)
_MOST_LETTERS = 300  # of a compiler's own message, which may hold a whole program


@dataclass(frozen=True, kw_only=True)
class CompilerCache:
    """The folder in which a compiler keeps its work, and the variable of the environment that moves it."""

    compiler: str
    variable: str
    folder: Path


def torch_cache() -> CompilerCache:
    """Return the cache of `torch.compile`, which makes it in the temporary folder by user."""
    variable = "TORCHINDUCTOR_CACHE_DIR"
    folder = (
        os.environ.get(variable) or Path(tempfile.gettempdir()) / f"torchinductor_{_user_name()}"
    )
    return CompilerCache(compiler="torch.compile", variable=variable, folder=Path(folder))


def triton_cache() -> CompilerCache:
    """Return the cache of Triton."""
    variable = "TRITON_CACHE_DIR"
    folder = os.environ.get(variable) or Path(os.path.expanduser("~")) / ".triton" / "cache"
    return CompilerCache(compiler="Triton", variable=variable, folder=Path(folder))


def explained(error: BaseException) -> str | None:
    """Return one line about an error that a compiler raised, which names its cache and the fix; None for others."""
    first: BaseException | None = error
    seen: set[int] = set()
    while first is not None and id(first) not in seen:
        seen.add(id(first))
        for frame, _ in traceback.walk_tb(first.__traceback__):
            module = str(frame.f_globals.get("__name__"))
            if module.startswith(_COMPILERS):
                return _explanation(error, triton_alone=module.startswith("triton"))
        first = first.__cause__ or first.__context__
    return None


def _user_name() -> str:
    """Return the user's name, which torch puts into the name of its folder, or the user's number if it has no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # an id without a name, as in containers
        return str(os.getuid())


def _explanation(error: BaseException, *, triton_alone: bool) -> str:
    said = " ".join(str(error).split())[:_MOST_LETTERS]
    # Torch compiles kernels of Triton for a GPU.
    caches = [triton_cache()] if triton_alone else [torch_cache(), triton_cache()]
    advice = ", ".join(
        f"{cache.compiler}'s {cache.folder} (or set {cache.variable} to another folder)"
        for cache in caches
    )
    return (
        f"a compiler failed: {type(error).__name__}: {said}; if a file in its cache is damaged, such as by a "
        f"full disk, delete {advice}"
    )
