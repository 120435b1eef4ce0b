"""Launches that are recorded once: each one has its own numbers and its own size."""

import threading

import pytest
import torch

from ksim_rl.device import native_kernel
from ksim_rl.device.quick_launch import ADDRESS, QuickLaunch, address, arguments_of, as_operator

CPU = torch.device("cpu")


LINE = arguments_of(
    (float, "slope"), ("int64", "offset"), ("uint32", "shift"), (int, "scale"), (ADDRESS, "out")
)


@pytest.fixture
def launch() -> QuickLaunch:
    return QuickLaunch(
        LINE,
        "((double*)a.out)[i] = (double)a.slope * i + (double)a.offset + a.shift + a.scale;",
        ("i", "lane"),
    )


def line(launch: QuickLaunch, size: int, slope: float, *numbers: int) -> list[float]:
    out_N = torch.full((size + 1,), -1.0, dtype=torch.float64)
    launch(CPU, (size, 1), slope, *numbers, address(out_N))
    assert out_N[-1] == -1, "nothing is written beyond the launch's size"
    return out_N[:-1].tolist()


def test_each_launch_has_its_own_numbers_and_size(launch):
    assert line(launch, 3, 0.5, -(2**52), 2**32 - 1, -7) == [
        i / 2 - 2**52 + 2**32 - 8 for i in range(3)
    ]
    assert line(launch, 3, 2.0, 1, 0, 0) == [1, 3, 5]
    assert line(launch, 2, 1.0, 0, 0, 10) == [10, 11]
    assert line(launch, 3, 0.0, 4, 0, 0) == [4, 4, 4]


def test_no_size_no_launch(launch):
    assert line(launch, 0, 1.0, 0, 0, 0) == []


def test_many_sizes_do_not_pile_up(launch, monkeypatch):
    monkeypatch.setattr(native_kernel, "MAX_RECORDED", 3)
    for size in [*range(1, 12), 1, 2]:
        assert line(launch, size, 1.0, size, 0, 0) == [size + i for i in range(size)]
    assert len(launch._kernel._recorded) <= 3


def test_numbers_of_two_threads_do_not_mix(launch):
    wrong: list[int] = []

    def work(number: int) -> None:
        for _ in range(300):
            if line(launch, 4, 1.0, number, 0, 0) != [number + i for i in range(4)]:
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in (100, 200)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_none_lies_nowhere():
    assert address(None) == 0


def test_arguments_that_an_operator_changes_have_no_default():
    def fill(out_N: torch.Tensor, count_N: torch.Tensor | None = None) -> None:
        out_N.fill_(1.0)

    with pytest.raises(
        AssertionError, match="fill_counted: arguments that are changed have no default"
    ):
        as_operator("fill_counted", fill, lambda *_: None, mutates=("out_N", "count_N"))
