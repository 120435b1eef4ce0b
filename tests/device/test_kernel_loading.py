"""Kernels that are loaded together; a kernel that has not run must not have run."""

import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import torch
import warp as wp

from ksim_rl.device import kernel_loading
from ksim_rl.device.kernel_loading import compile_notice, loaded_together
from ksim_rl.device.streams import warp_scope

LINE = "Module mujoco_warp._src.smooth 1a2b3c4 load on device 'cpu' took {ms} ms  ({how})"
CPU = torch.device("cpu")


@wp.kernel(module="unique", enable_backward=False)
def add_one(values: wp.array[float]):
    values[wp.tid()] += 1.0


def test_launches_of_the_block_are_loaded_and_not_run():
    with warp_scope(CPU):
        values = wp.zeros(3, dtype=float, device="cpu")
        assert not add_one.module.execs
        with loaded_together(CPU):
            wp.launch(add_one, 3, inputs=[values], device="cpu")
            wp.launch(add_one, dim=0, inputs=[values], device="cpu")
        assert add_one.module.execs
        assert values.numpy().tolist() == [0.0] * 3
        wp.launch(add_one, dim=3, inputs=[values], device="cpu")
        assert values.numpy().tolist() == [1.0] * 3


def two_kernels(module: str, *, adds: float = 2.0) -> tuple[wp.Kernel, wp.Kernel]:
    """Return kernels of a module of this name, which double, and which add a constant."""
    number, own = wp.constant(adds), wp.get_module(module)

    @wp.func
    def add(value: float):
        return value + number

    def double(values: wp.array[float]):
        values[wp.tid()] *= 2.0

    def increase(values: wp.array[float]):
        values[wp.tid()] = add(values[wp.tid()])

    return wp.Kernel(double, key="double", module=own), wp.Kernel(
        increase, key="increase", module=own
    )


def launch(*kernels: wp.Kernel, values: wp.array) -> list[float]:
    """Launch kernels one after the other, and return what they leave."""
    for kernel in kernels:
        wp.launch(kernel, dim=1, inputs=[values], device="cpu")
    return values.numpy().tolist()


def load(*kernels: wp.Kernel) -> None:
    """Load kernels together."""
    with warp_scope(CPU), loaded_together(CPU):
        launch(*kernels, values=wp.ones(1, dtype=float, device="cpu"))


@pytest.fixture
def values():
    with warp_scope(CPU):
        yield wp.ones(1, dtype=float, device="cpu")


def test_what_is_launched_of_a_module_is_compiled_without_the_rest_of_it(values):
    double, increase = two_kernels("rest")
    whole = double.module
    whole.options["fast_math"] = True
    load(increase)
    assert [*increase.module.kernels] == ["increase"] and increase.module.execs
    assert increase.module.options == whole.options
    assert double.module is whole and not whole.execs
    assert launch(increase, double, increase, values=values) == [8.0]


def test_kernels_of_another_model_get_a_module_of_their_own(values):
    double, increase = two_kernels("other_model")
    load(double)
    first = double.module
    load(double, increase)
    assert double.module is first and increase.module.name == "other_model.increase"
    assert launch(double, increase, values=values) == [4.0]


def test_a_loaded_module_stays_whole_and_so_do_recorded_launches(values):
    double, increase = two_kernels("loaded")
    record = wp.launch(double, dim=1, inputs=[values], device="cpu", record_cmd=True)
    load(increase)
    assert increase.module is double.module
    record.launch()
    assert launch(increase, values=values) == [4.0]


def test_a_module_that_another_device_has_loaded_is_loaded_whole(values):
    _, increase = two_kernels("other_device")
    whole = increase.module
    whole.execs["context of a GPU", 256] = None
    load(increase)
    assert increase.module is whole and (None, 1) in whole.execs
    assert launch(increase, values=values) == [3.0]


def test_a_module_of_the_same_content_has_the_same_name_and_hash_and_another_constant_another_hash():
    """The next process finds it in Warp's cache; names differ here, as a process has one of each."""
    made = {
        name: two_kernels(name, adds=adds) for name, adds in (("a", 2.0), ("b", 2.0), ("c", 3.0))
    }
    load(*(increase for _, increase in made.values()))
    modules = {name: increase.module for name, (_, increase) in made.items()}
    assert [module.name for module in modules.values()] == [
        "a.increase",
        "b.increase",
        "c.increase",
    ]
    hashes = {name: module.get_module_hash(1) for name, module in modules.items()}
    assert hashes["a"] == hashes["b"] != hashes["c"]


def test_kernels_that_are_made_again_do_not_take_the_place_of_the_first(values):
    made = [two_kernels("again", adds=adds)[1] for adds in (2.0, 10.0)]
    for increase in made:
        load(increase)
    assert launch(*made, *made, values=values) == [25.0]


def test_overloads_of_a_generic_kernel_are_launched_with_it_as_before(values):
    @wp.kernel(module=wp.get_module("generic"), enable_backward=False)
    def square(values: wp.array[Any]):
        values[wp.tid()] *= values[wp.tid()]

    whole = wp.array([3], dtype=int, device="cpu")
    load(*(wp.overload(square, [wp.array(dtype=kind)]) for kind in (float, int)))
    assert launch(square, values=whole) == [9]
    values.fill_(1.5)
    assert launch(square, values=values) == [2.25]


def test_another_thread_waits_until_what_was_put_apart_is_loaded(monkeypatch):
    double, increase = two_kernels("threads")
    wp.Kernel(double.func, key="third", module=double.module)
    loading, loaded = threading.Event(), []

    def slowly(modules, device):
        loading.set()
        time.sleep(0.1)
        some = [module for module, _ in modules if module.name.startswith("threads")]
        loaded.append([module.name for module in some])
        for module in some:
            module.execs[None, 1] = None  # as if it were

    def load_some(*kernels: wp.Kernel) -> None:
        with loaded_together(CPU):
            for kernel in kernels:
                wp.launch(kernel, dim=1)

    monkeypatch.setattr(kernel_loading, "load", slowly)
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(load_some, double, increase)
        loading.wait(10.0)
        load_some(increase)
        first.result()
    assert loaded == [["threads.double"]] * 2


@pytest.fixture
def compilers(monkeypatch):
    """The threads that were to load something, of which there are two at most."""
    threads: list[threading.Thread] = []

    def note(*args, **options) -> None:
        threads.append(threading.current_thread())

    monkeypatch.setattr(kernel_loading, "MOST_WORKERS", 2)
    monkeypatch.setattr(wp, "force_load", note)
    return threads


MODULES = [(wp.get_module(name), None) for name in ("one", "two", "three")]


def test_threads_that_compile_stay_for_later_kernels(compilers):
    """A new one would precompile Warp's header again, which takes a second."""
    for _ in range(3):
        kernel_loading.load(MODULES, CPU)
    assert len(compilers) == 9 and len(set(compilers)) <= min(2, os.cpu_count() or 1)


def test_a_single_compiler_is_the_thread_that_asks(compilers, monkeypatch):
    monkeypatch.setattr(kernel_loading, "MOST_WORKERS", 1)
    kernel_loading.load(MODULES, CPU)
    assert compilers == [threading.current_thread()] * 3


def test_a_forked_child_has_threads_of_its_own_that_compile(compilers):
    kernel_loading.load(MODULES, CPU)
    child = os.fork()
    if not child:
        # Nothing of pytest's runs in the child, whatever happens.
        try:
            kernel_loading.load(MODULES, CPU)
        finally:
            os._exit(len(compilers))
    ended, status = 0, 0
    deadline = time.monotonic() + 30.0
    while not ended and time.monotonic() < deadline:
        ended, status = os.waitpid(child, os.WNOHANG)
        time.sleep(0.01)
    if not ended:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    assert ended, "it waits for threads of its parent"
    assert os.waitstatus_to_exitcode(status) == 6


def test_compiled_modules_call_the_hook_and_cached_ones_do_not():
    lines: list[str] = []
    with compile_notice(lines.append):
        wp.get_logger().info(LINE.format(ms="900.00", how="cached"))
        wp.get_logger().info("Warp 1.19.0 initialized:")
        wp.get_logger().info(LINE.format(ms="1500.00", how="compiled"))
        wp.get_logger().info(LINE.format(ms="2500.25", how="compiled"))
    assert len(lines) == 2
    assert "compiling Warp kernels (first use of this model" in lines[0]
    assert str(wp.config.kernel_cache_dir) in lines[0]
    assert lines[1].endswith("2 modules, 4 s")


def test_warp_is_silent_and_the_hook_is_put_back(capsys):
    with compile_notice(lambda text: None):
        wp.get_logger().info(LINE.format(ms="10.00", how="compiled"))
    wp.get_logger().info(LINE.format(ms="10.00", how="cached"))
    assert capsys.readouterr().out == ""


def test_a_loaded_kernel_is_told_in_the_format_that_the_notice_reads(tmp_path):
    @wp.kernel(enable_backward=False, module="unique")
    def increment(values: wp.array[float]):
        values[wp.tid()] += 1.0

    cache, wp.config.kernel_cache_dir = wp.config.kernel_cache_dir, str(tmp_path)
    lines: list[str] = []
    try:
        with compile_notice(lines.append):
            wp.launch(
                increment, dim=1, inputs=[wp.zeros(1, dtype=float, device="cpu")], device="cpu"
            )
    finally:
        wp.config.kernel_cache_dir = cache
    assert len(lines) == 1


def test_each_block_counts_from_one():
    for _ in range(2):
        lines: list[str] = []
        with compile_notice(lines.append):
            wp.get_logger().info(LINE.format(ms="2000.00", how="compiled"))
        assert lines[0].endswith("1 modules, 2 s")
