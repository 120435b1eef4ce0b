"""Headers of kernels: their text, their struct and constants, and that they compile alone and are never an old one."""

import functools
import shutil
import sys

import pytest
import torch

from ksim_rl.device import headers
from ksim_rl.device.quick_launch import launch_of
from tests import headers as syntax
from tests.docs.guide import REPOSITORY

CPU = torch.device("cpu")
CONSTANTS: dict[str, headers.Constant] = {"OFFSET": 7, "SIGNS": [1, 1]}
SHARED = """// What two share.
#pragma once
#include "builtin.h"
CUDA_CALLABLE inline float scaled(float x) { return 2.0f * x; }

// What several kernels take.
struct Counted {
    const long long* count;
};
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
constexpr int SIGNS[] = {1, 1};
}

struct Arguments : Counted {
    float slope;  // of the line
    // Where it goes.
    float* out;
};

CUDA_CALLABLE inline void run(int row, int, const Arguments& a)
{
    if (row < *a.count)
        a.out[row] = given::SIGNS[row] * scaled(a.slope) * row + given::OFFSET;
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


def line(offset: int, signs: tuple[int, ...] = (1, 1)) -> list[float]:
    out_N = torch.zeros(3)
    count = torch.tensor(2)
    launch = launch_of("toy/kernel.cuh", {"OFFSET": offset, "SIGNS": signs})
    launch(CPU, (3, 1), count.data_ptr(), 0.5, out_N.data_ptr())
    return out_N.tolist()


def test_a_header_that_is_edited_makes_another_kernel(toy):
    assert line(7) == [7.0, 8.0, 0.0]
    shared = toy / "shared.cuh"
    shared.write_text(SHARED.replace("2.0f", "6.0f"))
    assert line(7) == [7.0, 10.0, 0.0]
    assert line(7, signs=(1, -1)) == [7.0, 4.0, 0.0]


def test_each_header_comes_once_and_before_those_that_include_it(toy):
    text = headers.text_of("toy/kernel.cuh", CONSTANTS)
    assert text.count("float scaled(") == 1
    assert text.index("float scaled(") < text.index("namespace kernel")
    assert "#include" not in text
    assert headers.arguments_of(text) == {
        "count": "const long long*",
        "slope": "float",
        "out": "float*",
    }


@pytest.mark.parametrize(
    "constants", [{}, {"OFFSET": 1}, {**CONSTANTS, "LENGTH": 2}, {"OFSET": 1, "SIGNS": [1]}]
)
def test_constants_are_declared_and_given(toy, constants):
    with pytest.raises(AssertionError, match="are declared or given, but not both"):
        headers.text_of("toy/kernel.cuh", constants)


GIVEN = "constexpr int OFFSET = 100;"


@pytest.mark.parametrize(
    ("written", "instead", "message"),
    [
        ("float slope;", "float slope, other;", "a field is a line of its own"),
        ("float slope;", "bool slope;", "slope is of type 'bool': expected a pointer, or"),
        ("struct Arguments :", "struct Fields :", "has a line `struct Arguments {`"),
        (": Counted {", ": Numbered {", "inherits from 'Numbered', which one struct has to be"),
        ("float slope;", "float count;", "Arguments has a field twice: count"),
        ('shared.cuh"', 'shared.cuh"  // both', "an include is a line of its own: '#include"),
        # Missing samples would reach the kernel.
        ("given {", "given\n{", "`namespace given {` is a line of its own"),
        (GIVEN, GIVEN + "\nconstexpr bool IS_FAST = true;", "and no 'constexpr bool IS_FAST"),
        (GIVEN, GIVEN + "\n  constexpr int LENGTH = 3;", "and no '  constexpr int LENGTH"),
        (GIVEN, GIVEN + "\nconstexpr int A = 1, B = 2;", "and no 'constexpr int A = 1, B"),
    ],
)
def test_what_python_would_misread_is_refused(toy, written, instead, message):
    assert KERNEL.count(written) == 1
    (toy / "kernel.cuh").write_text(KERNEL.replace(written, instead))
    with pytest.raises(AssertionError, match=message):
        launch_of("toy/kernel.cuh", CONSTANTS)


@pytest.mark.parametrize(
    ("constants", "message"),
    [
        ({"OFFSET": 5_000_000_000}, "OFFSET=5000000000 is no int"),
        ({"SIGNS": [1, 5_000_000_000]}, "SIGNS=5000000000 is no int"),
        ({"SIGNS": []}, "the table SIGNS is empty"),
        ({"SIGNS": 1}, "SIGNS=1, and there 'constexpr int SIGNS"),
        ({"OFFSET": [1]}, "OFFSET=.*, and there 'constexpr int OFFSET = "),
    ],
)
def test_a_constant_is_an_int_of_cpp_and_a_table_has_several(toy, constants, message):
    with pytest.raises(AssertionError, match=message):
        headers.text_of("toy/kernel.cuh", {**CONSTANTS, **constants})


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


@pytest.mark.parametrize(
    ("first", "begins"),
    [
        ('#include "builtin.h"\n', True),
        # Through another header.
        ('// Its reason.\n#pragma once\n#include "toy/between.cuh"\n', True),
        ("", False),
        ("struct Before {};\n" + '#include "builtin.h"\n', False),
        ('#include "toy/empty.cuh"\n#include "builtin.h"\n', False),
        ('#include "toy/missing.cuh"\n', False),
    ],
)
def test_a_header_that_a_precompiled_one_would_help_out_is_compiled_without(toy, first, begins):
    (toy / "empty.cuh").write_text("#pragma once\n")
    header = toy / "first.cuh"
    header.write_text(first + "CUDA_CALLABLE inline int one() { return 1; }\n")
    assert syntax.begins_with_builtin(header, toy.parent) == begins


@pytest.mark.full
def test_a_precompiled_header_hides_no_error(toy, tmp_path):
    compiler = syntax.COMPILERS[0]
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no {compiler}")
    precompiled = syntax.precompile_builtin(tmp_path)
    kernel = toy / "kernel.cuh"
    errors = functools.partial(syntax.errors_of, kernel, compiler, toy.parent, precompiled)
    assert not errors()
    kernel.write_text(KERNEL.replace("scaled(", "scald("))
    assert "scald" in errors()
    # A header that forgot to include it.
    kernel.write_text(KERNEL[KERNEL.index("namespace kernel") :])
    assert "CUDA_CALLABLE" in errors()


def test_each_file_of_cpp_is_a_part_of_a_kernel():
    """Python names it, or another header includes it: what a move leaves behind would rot unseen."""
    package = REPOSITORY / "ksim_rl"
    texts = [path.read_text() for path in package.rglob("*.py")]
    texts += [path.read_text() for path in package.rglob("*.cuh")]
    code = "\n".join(texts)
    for path in package.rglob("*.cuh"):
        assert f'"{path.relative_to(REPOSITORY)}"' in code, f"{path}: nothing includes it"
    fragments = [*package.rglob("*.cpp")]
    assert not fragments, "C++ of kernels is in headers, which compile alone"
