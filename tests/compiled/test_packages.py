"""Libraries are distinguished from a user's packages, wherever an installer has put them."""

import importlib
import sys

import pytest

from ksim_rl.compiled import packages


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder on the path with a package in it, and nothing remembered of before or after."""
    (tmp_path / "strange_lib").mkdir()
    (tmp_path / "strange_lib" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    _forget()
    yield tmp_path
    sys.modules.pop("strange_lib", None)
    _forget()


def _forget():
    packages.is_library.cache_clear()
    packages._installed_into.cache_clear()


def test_a_package_that_pip_has_put_into_a_folder_of_its_own_is_a_library(folder):
    about = folder / "strange_lib-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: strange-lib\nVersion: 1.0\n")
    (about / "INSTALLER").write_text("pip\n")
    importlib.import_module("strange_lib")
    assert packages.is_library("strange_lib")


def test_a_project_in_a_folder_of_its_own_is_none(folder):
    importlib.import_module("strange_lib")
    assert not packages.is_library("strange_lib")


def test_what_training_is_built_on_are_libraries():
    for name in ("torch", "tensordict", "torchrl", "numpy", "mujoco", "ksim_rl"):
        importlib.import_module(name)
        packages.is_library.cache_clear()
        assert packages.is_library(name), name
