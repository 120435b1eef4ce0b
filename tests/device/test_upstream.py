"""What device uses of torch and Warp beyond their documents is still there; each failure names the thing that moved."""

import inspect
import re
import time
from pathlib import Path

import pytest
import torch
import warp as wp
from warp._src.build import build_cpu

from ksim_rl.device import upstream
from ksim_rl.device.streams import start_warp


@wp.struct
class Pair:
    first: int
    second: float


@wp.kernel(module="unique", enable_backward=False)
def take_pair(pair: Pair):
    wp.tid()


@pytest.mark.parametrize(
    "name", ["launch", "launch_tiled", "capture_while", "force_load", "from_torch", "get_module"]
)
def test_warp_has_the_functions_that_are_diverted_or_called(name: str) -> None:
    assert callable(getattr(wp, name, None)), f"warp.{name} is gone"


def test_launches_begin_with_kernel_and_dim() -> None:
    parameters = list(inspect.signature(wp.launch).parameters)
    assert parameters[:2] == ["kernel", "dim"] and "block_dim" in parameters, (
        "warp.launch takes other arguments"
    )
    assert list(inspect.signature(wp.capture_while).parameters)[:2] == ["condition", "while_body"]


def test_kernels_tell_their_module_and_whether_they_are_generic() -> None:
    assert take_pair.is_generic is False, "warp.Kernel.is_generic means something else"
    assert isinstance(take_pair.module, wp.Module), "warp.Kernel.module is something else"


def test_modules_list_their_kernels_and_what_is_loaded_and_take_others() -> None:
    module = wp.get_module("some_module")
    assert wp.get_module("some_module") is module and module.name == "some_module"
    assert module.execs == {} and isinstance(module.options, dict), (
        "warp.Module.execs or options are others"
    )
    assert module.has_unresolved_static_expressions is False, (
        "warp.Module resolves wp.static otherwise"
    )
    module.register_kernel(take_pair)
    assert module.kernels == {take_pair.key: take_pair}, "warp.Module.kernels is something else"


def test_modules_load_by_device_and_block_from_a_folder_of_the_cache() -> None:
    parameters = list(inspect.signature(inspect.unwrap(wp.Module.load)).parameters)
    assert parameters[:3] == ["self", "device", "block_dim"], (
        "warp.Module.load takes other arguments"
    )
    wp.init()
    assert isinstance(wp.config.kernel_cache_dir, str), (
        "warp.config.kernel_cache_dir is something else"
    )
    folder = take_pair.module.get_module_identifier(1)
    assert folder.startswith("wp_"), "warp.Module.get_module_identifier names something else"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (None, "-march=native -fpch-instantiate-templates"),
        ("", "-fpch-instantiate-templates"),
        (
            "-march=native -fno-vectorize",
            "-march=native -fno-vectorize -fpch-instantiate-templates",
        ),
    ],
)
def test_flags_of_the_user_stay_beside_that_of_templates(
    before: str | None, after: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wp.config, "cpu_compiler_flags", before)
    # A second call adds nothing.
    for _ in range(2):
        upstream.keep_templates_in_header()
        assert wp.config.cpu_compiler_flags == after


def test_what_is_compiled_after_the_start_keeps_templates_in_the_header() -> None:
    start_warp()
    assert upstream.TEMPLATES_IN_HEADER in wp.config.cpu_compiler_flags.split()
    options = take_pair.module.resolve_options(wp.config)
    assert upstream.TEMPLATES_IN_HEADER in options["cpu_compiler_flags"], (
        "warp.config.cpu_compiler_flags no longer reaches modules"
    )


@pytest.mark.full
def test_templates_in_the_header_are_not_worked_out_for_each_module(tmp_path: Path) -> None:
    start_warp()
    source = tmp_path / "empty.cpp"
    source.write_text("int nothing() { return 0; }")
    seconds = {}
    for flags in ("-march=native", f"-march=native {upstream.TEMPLATES_IN_HEADER}"):
        # The first one writes the header.
        for _ in range(3):
            start = time.thread_time()
            build_cpu(
                str(tmp_path / "empty.o"),
                str(source),
                optimization_level=0,
                use_precompiled_headers=True,
                pch_dir=str(tmp_path),
                block_dim=1,
                extra_flags=flags,
            )
            seconds[flags] = time.thread_time() - start
    without, with_templates = seconds.values()
    assert with_templates < without / 3, "Clang's -fpch-instantiate-templates does nothing any more"


def test_diversion_ends_with_its_block() -> None:
    before, seen = wp.launch, []
    with upstream.launches_diverted(
        lambda kernel, dim, block_dim: seen.append((kernel, dim, block_dim))
    ):
        wp.launch(take_pair, 3, block_dim=64)
        wp.capture_while(None, lambda times: seen.append(times), times=1)
    assert seen == [(take_pair, 3, 64), 1] and wp.launch is before


def test_a_recorded_launch_has_its_struct_as_the_second_parameter() -> None:
    launch = wp.launch(take_pair, 1, inputs=[Pair()], device="cpu", record_cmd=True)
    fields = upstream.recorded_arguments(launch)._fields_
    assert [name for name, _ in fields] == ["first", "second"], (
        "warp.Launch.params is laid out otherwise"
    )


def test_warp_logs_modules_as_before(capsys: pytest.CaptureFixture[str]) -> None:
    lines: list[str] = []

    class Logger:
        def info(self, message: str) -> None:
            lines.append(message)

        def __getattr__(self, name: str):
            return lambda *args, **kwargs: None

    @wp.kernel(module="unique", enable_backward=False)
    def never_compiled_before(values: wp.array[float], salt: int):
        values[wp.tid()] = float(salt)

    before = wp.get_logger()
    wp.set_logger(Logger())
    try:
        wp.launch(never_compiled_before, 1, inputs=[wp.zeros(1, device="cpu"), 1], device="cpu")
    finally:
        wp.set_logger(before)
    load = [line for line in lines if "Module " in line and "took" in line]
    assert load, "Warp logs no module loads"
    assert re.search(r"\((compiled|cached)\)", load[0]), (
        f"Warp ends a load line otherwise: {load[0]!r}"
    )
    assert upstream.COMPILED_LINE.match(load[0].replace("(cached)", "(compiled)")), (
        f"COMPILED_LINE misses {load[0]!r}"
    )


def test_a_default_logger_is_recognized() -> None:
    before = wp.get_logger()
    wp.set_logger(None)
    try:
        assert upstream.has_default_logger(), "warp.LoggerBasic has another name"
    finally:
        wp.set_logger(before)


def test_torch_says_what_it_could_not_allocate() -> None:
    with pytest.raises(RuntimeError) as refusal:
        torch.empty(1 << 50)
    assert re.search(upstream.ALLOCATION_REFUSALS[2], str(refusal.value)), (
        f"torch says now: {refusal.value}"
    )


@pytest.mark.gpu
def test_torch_has_the_handle_of_its_current_stream() -> None:
    device = torch.device("cuda", torch.cuda.current_device())
    assert hasattr(torch._C, "_cuda_getCurrentRawStream"), (
        "torch._C._cuda_getCurrentRawStream is gone"
    )
    assert upstream.current_stream_handle(device) == torch.cuda.current_stream(device).cuda_stream
