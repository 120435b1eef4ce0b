"""Enforces shape annotations while the tests run, and keeps runs small and repeatable."""

import functools
import gc
import importlib.metadata
import os
from pathlib import Path

# Read when torch is imported: workers that each take all cores slow each other down many times over.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# Read when hypothesis is imported: a plug-in for trio, which no test uses, would look through all objects.
os.environ.setdefault("HYPOTHESIS_NO_PLUGINS", "1")

import pytest
import torch
import warp as wp

from tests import known_functions, shapes

# Read when Triton is imported: without CUDA its kernels run in its interpreter.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

# Robots that lie beside the checkout are used; tests that need one skip where there is none.
_MENAGERIE = Path(__file__).parents[2] / "shared" / "menagerie"
if _MENAGERIE.is_dir():
    os.environ.setdefault("MENAGERIE_ROOT", str(_MENAGERIE))


# MuJoCo Warp reads a version from its file six times for each env, a seventh of the time that a small one takes.
importlib.metadata.version = functools.cache(importlib.metadata.version)

known_functions.install()
# Before any test imports the package.
shapes.install()

_THREADS = torch.get_num_threads()


@pytest.fixture(autouse=True)
def _fresh_torch():
    """Start each test from the same seed, threads and exact products, with nothing compiled: tests share code."""
    if torch.get_num_threads() != _THREADS:
        torch.set_num_threads(_THREADS)
    torch.manual_seed(0)
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = False
    torch.compiler.reset()


@pytest.fixture(autouse=True, scope="module")
def _small_heap():
    """Leave what a file's tests keep, such as compiled code, out of the garbage collections of later files."""
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def _own_plugins():
    """Forget the plug-ins that a file's tests name: the next file's child processes would look for them in vain."""
    # Imported here, after the shapes are enforced.
    from ksim_rl.config import plugins

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plugins, "_named", [*plugins._named])
        patch.setattr(plugins, "_allowed", {*plugins._allowed})
        for variable in (plugins.VARIABLE, plugins.PATH_VARIABLE):
            # The patch takes back what tests assign from here on.
            patch.setenv(variable, os.environ.get(variable, ""))
        yield


def _compiles_in_haste(config: pytest.Config) -> bool:
    """Whether kernels are for the CPU, and the long tests do not run."""
    long_tests_run = "full" in config.option.markexpr.replace("not full", "")
    return not long_tests_run and not torch.cuda.is_available()


def pytest_configure(config):
    """Compile the CPU's kernels without optimization, in half of the time, where the long tests do not run.

    `make test-full` runs with the optimized kernels that users get.
    """
    if _compiles_in_haste(config):
        wp.config.optimization_level = 0
        # Warp's own flag, and without LLVM's proof of what Clang gives it, a tenth of the time.
        wp.config.cpu_compiler_flags = "-march=native -disable-llvm-verifier"


@pytest.fixture(autouse=True, scope="session")
def _one_compiler(pytestconfig):
    """Compile in the thread of the test: workers share the cores, and each thread precompiles Warp's header."""
    if not _compiles_in_haste(pytestconfig):
        yield
        return
    # Imported here, after the shapes are enforced.
    from ksim_rl.device import kernel_loading

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel_loading, "MOST_WORKERS", 1)
        yield


def pytest_collection_modifyitems(items):
    """Skip tests that need a GPU where there is none."""
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Import the tests without garbage collections, and leave what was imported out of later ones.

    They take a quarter of that time otherwise, and find nothing. `check_env` makes two for each env.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()
