import warp as wp

from ksim_rl.device.compile_notice import compile_notice

LINE = "Module mujoco_warp._src.smooth 1a2b3c4 load on device 'cpu' took {ms} ms  ({how})"


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
