"""Kernels that are loaded together; a kernel that has not run must not have run."""

import torch
import warp as wp

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


@wp.kernel(enable_backward=False)
def double(values: wp.array[float]):
    values[wp.tid()] *= 2.0


@wp.kernel(enable_backward=False)
def negate(values: wp.array[float]):
    values[wp.tid()] *= -1.0


def test_what_is_launched_of_a_module_is_compiled_without_the_rest_of_it():
    with warp_scope(CPU):
        values, whole = wp.ones(3, dtype=float, device="cpu"), negate.module
        with loaded_together(CPU):
            wp.launch(double, dim=3, inputs=[values], device="cpu")
        assert [*double.module.kernels] == ["double"] and double.module.execs
        assert double.module is not whole is negate.module and not whole.execs
        for kernel in (double, negate):
            wp.launch(kernel, dim=3, inputs=[values], device="cpu")
        assert values.numpy().tolist() == [-2.0] * 3
        apart = double.module
        with loaded_together(CPU):
            for kernel in (double, negate):
                wp.launch(kernel, dim=3, inputs=[values], device="cpu")
        assert double.module is apart and negate.module is whole


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
            wp.launch(increment, dim=1, inputs=[wp.zeros(1, dtype=float, device="cpu")], device="cpu")
    finally:
        wp.config.kernel_cache_dir = cache
    assert len(lines) == 1


def test_each_block_counts_from_one():
    for _ in range(2):
        lines: list[str] = []
        with compile_notice(lines.append):
            wp.get_logger().info(LINE.format(ms="2000.00", how="compiled"))
        assert lines[0].endswith("1 modules, 2 s")
