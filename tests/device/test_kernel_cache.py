"""What is damaged in Warp's cache is compiled again, and said once; what cannot be mended names the fix."""

import os
import shutil
from pathlib import Path

import pytest
import torch
import warp as wp

from ksim_rl.device import kernel_cache
from ksim_rl.device.streams import start_warp, warp_scope

CPU = torch.device("cpu")


@wp.kernel(module="damaged", enable_backward=False)
def triple(values: wp.array[float]):
    values[wp.tid()] *= 3.0


def run() -> list[float]:
    """Load the kernel from the cache, as another process would, and launch it."""
    triple.module.execs.clear()
    with warp_scope(CPU):
        values = wp.ones(2, dtype=float, device="cpu")
        wp.launch(triple, 2, inputs=[values], device="cpu")
    return values.numpy().tolist()


@pytest.fixture
def files(tmp_path, monkeypatch) -> list[Path]:
    """Return the files of the kernel in a cache of its own."""
    start_warp()  # which sets the folder of the cache, that the other tests have
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    kernel_cache._said.clear()
    assert run() == [3.0, 3.0]
    return sorted(tmp_path.rglob("*.*"))


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


def empty(path):
    os.truncate(path, 0)


def fill_with_others(path):
    path.write_bytes(bytes(range(256)))


def become_folder(path):
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("damage", [cut, empty, fill_with_others, become_folder, Path.unlink])
@pytest.mark.parametrize("kind", [".o", ".meta"])
def test_what_is_damaged_is_compiled_again(damage, kind, files, tmp_path, capfd):
    (path,) = [path for path in files if path.suffix == kind]
    damage(path)
    assert run() == [3.0, 3.0]
    said = capfd.readouterr().err
    assert said.count(f"Warp's cache {tmp_path} is damaged") == (damage is not Path.unlink)
    assert run() == [3.0, 3.0]
    assert "damaged" not in capfd.readouterr().err


def test_what_cannot_be_deleted_names_the_cache_and_the_fix(files, tmp_path, monkeypatch):
    def refuse(folder):
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr(shutil, "rmtree", refuse)
    for path in files:
        empty(path)
    with pytest.raises(
        RuntimeError, match=rf"Warp's cache: {tmp_path}.*nor deleted.*set WARP_CACHE_PATH"
    ):
        run()


def test_what_stays_damaged_ends_in_one_line(files, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "rmtree", lambda folder: None)
    for path in files:
        empty(path)
    with pytest.raises(
        RuntimeError, match=rf"Warp's cache: {tmp_path}.*read or written.*WARP_CACHE_PATH"
    ):
        run()


def test_a_kernel_that_does_not_compile_is_no_damage(tmp_path, monkeypatch):
    start_warp()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))

    def wrong(values: wp.array[float]):
        values[wp.tid()] = no_such_function(1.0)  # noqa: F821

    kernel = wp.Kernel(wrong, key="wrong", module=wp.get_module("wrong"))
    with warp_scope(CPU), pytest.raises(Exception, match="no_such_function"):
        wp.launch(kernel, 1, inputs=[wp.ones(1, dtype=float, device="cpu")], device="cpu")
