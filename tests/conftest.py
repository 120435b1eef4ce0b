"""Enforces shape annotations while the tests run, and keeps runs small and repeatable."""

import importlib.machinery
import importlib.util
import inspect
import os
import sys
import typing
from pathlib import Path
from types import FunctionType, ModuleType

# Read when torch is imported: workers that each take all cores slow each other down many times over.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import beartype
import jaxtyping
import pytest
import torch
from jaxtyping import AbstractArray

# Read when Triton is imported: without CUDA its kernels run in its interpreter.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")

# Robots that lie beside the checkout are used; tests that need one skip where there is none.
_MENAGERIE = Path(__file__).parents[2] / "shared" / "menagerie"
if _MENAGERIE.is_dir():
    os.environ.setdefault("MENAGERIE_ROOT", str(_MENAGERIE))


def _names_a_shape(annotation: object) -> bool:
    if inspect.isclass(annotation) and issubclass(annotation, AbstractArray):
        return True
    return any(_names_a_shape(part) for part in typing.get_args(annotation))


def _checked(function: FunctionType) -> FunctionType:
    """Return `function` with its arguments and result checked, if an annotation of it names a shape."""
    try:
        annotations = inspect.get_annotations(function, eval_str=True)
    except NameError:  # a name that is imported for type checkers only
        return function
    if not any(_names_a_shape(annotation) for annotation in annotations.values()):
        return function
    return jaxtyping.jaxtyped(function, typechecker=beartype.beartype)


def _check_members(owner: ModuleType | type, module_name: str) -> None:
    for name, member in list(vars(owner).items()):
        if isinstance(member, FunctionType) and member.__module__ == module_name:
            checked = _checked(member)
            if checked is not member:
                setattr(owner, name, checked)
        elif isinstance(owner, ModuleType) and inspect.isclass(member) and member.__module__ == module_name:
            _check_members(member, module_name)


class _ShapeCheckingLoader(importlib.machinery.SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        _check_members(module, module.__name__)


class _ShapeCheckingFinder:
    """Wraps the functions of ksim_rl that carry jaxtyping annotations, and leaves all others alone.

    jaxtyping's own import hook wraps every function, Warp kernels among them, which Warp cannot read then.
    """

    def find_spec(self, fullname, path=None, target=None):
        if fullname.split(".")[0] != "ksim_rl":
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and type(spec.loader) is importlib.machinery.SourceFileLoader:
            spec.loader = _ShapeCheckingLoader(spec.loader.name, spec.loader.path)
        return spec


sys.meta_path.insert(0, _ShapeCheckingFinder())


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
