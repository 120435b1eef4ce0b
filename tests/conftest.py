"""Enforces shape annotations while the tests run, and keeps runs small and repeatable."""

import os
from pathlib import Path

# Read when torch is imported: workers that each take all cores slow each other down many times over.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

from tests import shapes

# Read when Triton is imported: without CUDA its kernels run in its interpreter.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

# Robots that lie beside the checkout are used; tests that need one skip where there is none.
_MENAGERIE = Path(__file__).parents[2] / "shared" / "menagerie"
if _MENAGERIE.is_dir():
    os.environ.setdefault("MENAGERIE_ROOT", str(_MENAGERIE))


# Before any test imports the package.
shapes.install()


@pytest.fixture(autouse=True)
def _fresh_torch():
    """Start each test from the same torch seed, with nothing compiled: tests share code, which compiles a few times."""
    torch.manual_seed(0)
    torch.compiler.reset()


def pytest_collection_modifyitems(items):
    """Skip tests that need a GPU where there is none."""
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))
