"""What device uses of torch and Warp beyond their documents is still there; each failure names the thing that moved."""

import inspect
import re

import pytest
import torch
import warp as wp

from ksim_rl.device import upstream


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
