"""Headers of kernels: their text, their struct and constants, and that they compile alone and are never an old one."""

import shutil
import sys

import pytest
import torch

from ksim_rl.device import headers
from ksim_rl.device.quick_launch import launch_of
from tests import headers as syntax
from tests.docs.guide import REPOSITORY

CPU = torch.device("cpu")
SHARED = """// What two share.
#pragma once
#include "builtin.h"
CUDA_CALLABLE inline float scaled(float x) { return 2.0f * x; }
"""
BETWEEN = """#pragma once
#include "toy/shared.cuh"
"""
KERNEL = """#pragma once
#include "toy/between.cuh"
#include "toy/shared.cuh"

namespace kernel {

namespace given {
constexpr int OFFSET = 100;  // an example
}

struct Arguments {
    float slope;  // of the line
    // Where it goes.
    const long long* count;
    float* out;
};

CUDA_CALLABLE inline void run(int row, int, const Arguments& a)
{
    if (row < *a.count)
        a.out[row] = scaled(a.slope) * row + given::OFFSET;
}

}
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A package with the headers of one kernel."""
    folder = tmp_path / "toy"
    folder.mkdir()
    for name, text in {"shared": SHARED, "between": BETWEEN, "kernel": KERNEL}.items():
        (folder / f"{name}.cuh").write_text(text)
    (folder / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    # One of the last test lay in another folder.
    monkeypatch.delitem(sys.modules, "toy", raising=False)
    return folder


def line(offset: int) -> list[float]:
    out_N = torch.zeros(3)
    count = torch.tensor(2)
    launch = launch_of("toy/kernel.cuh", {"OFFSET": offset})
    launch(CPU, (3, 1), 0.5, count.data_ptr(), out_N.data_ptr())
    return out_N.tolist()


def test_a_header_that_is_edited_makes_another_kernel(toy):
    assert line(7) == [7.0, 8.0, 0.0]
    shared = toy / "shared.cuh"
    shared.write_text(SHARED.replace("2.0f", "6.0f"))
    assert line(7) == [7.0, 10.0, 0.0]


def test_each_header_comes_once_and_before_those_that_include_it(toy):
    text = headers.text_of("toy/kernel.cuh", {"OFFSET": 7})
    assert text.count("float scaled(") == 1
    assert text.index("float scaled(") < text.index("namespace kernel")
    assert "#include" not in text
    assert headers.arguments_of(text) == {
        "slope": "float",
        "count": "const long long*",
        "out": "float*",
    }


@pytest.mark.parametrize("constants", [{}, {"OFFSET": 1, "LENGTH": 2}, {"OFSET": 1}])
def test_constants_are_declared_and_given(toy, constants):
    with pytest.raises(AssertionError, match="are declared or given, but not both"):
        headers.text_of("toy/kernel.cuh", constants)


def test_a_field_is_a_line_of_its_own(toy):
    kernel = toy / "kernel.cuh"
    kernel.write_text(KERNEL.replace("float slope;", "float slope, other;"))
    with pytest.raises(AssertionError, match="a field is a line of its own"):
        launch_of("toy/kernel.cuh", {"OFFSET": 1})


def test_headers_compile_alone(toy):
    compiler = next((name for name in syntax.COMPILERS if shutil.which(name)), None)
    if compiler is None:
        pytest.skip("there is no compiler")
    kernel = toy / "kernel.cuh"
    assert not syntax.errors_of(kernel, compiler, toy.parent)
    kernel.write_text(
        KERNEL.replace('#include "toy/between.cuh"\n', "").replace(
            '#include "toy/shared.cuh"\n', ""
        )
    )
    assert "CUDA_CALLABLE" in syntax.errors_of(kernel, compiler, toy.parent)


def test_each_file_of_cpp_is_a_part_of_a_kernel():
    """Python names it, or another header includes it: what a move leaves behind would rot unseen."""
    package = REPOSITORY / "ksim_rl"
    texts = [path.read_text() for path in package.rglob("*.py")]
    texts += [path.read_text() for path in package.rglob("*.cuh")]
    code = "\n".join(texts)
    for path in package.rglob("*.cuh"):
        assert f'"{path.relative_to(REPOSITORY)}"' in code, f"{path}: nothing includes it"
    # Fragments are named without their ending, by what lies in their folder.
    for path in package.rglob("*.cpp"):
        beside = "\n".join(own.read_text() for own in path.parent.glob("*.py"))
        assert f'"{path.stem}"' in beside, f"{path}: no kernel has it"
