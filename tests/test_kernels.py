"""Each kernel has a test that compares its bits."""

from tests import kernels

PACKAGE = kernels.REPOSITORY / "ksim_rl"
LISTED = {(file, name) for file, tests in kernels.TESTS.items() for name in tests}


def test_each_kernel_has_a_test_of_its_bits():
    sources = {str(path.relative_to(PACKAGE)): path.read_text() for path in PACKAGE.rglob("*.py")}
    found = kernels.kernels(sources)
    assert found - LISTED == set(), (
        "name a test that compares the bits of these in tests/kernels.py"
    )
    assert LISTED - found == set(), "these are no kernels (any more)"


def test_each_test_compares_bits():
    tests = {test for own in kernels.TESTS.values() for test in own.values()}
    assert [test for test in sorted(tests) if not kernels.compares_bits(test)] == []
    assert not kernels.compares_bits(
        "gpu/test_sensors.py::test_all_sensors_captured_read_what_the_c_engine_says"
    )
    assert not kernels.compares_bits("gpu/test_smooth.py::test_that_is_not_there")
    assert not kernels.compares_bits("gpu/test_nothing.py::test_it")


def test_kernels_of_all_kinds_are_found():
    sources = {
        "a.py": """
@triton.jit
def inner(x): ...
@triton.jit
def outer(x): ...
@triton.jit(noinline=True)
def other(x): ...
def run():
    launch(outer, (1,), {})
    other[4](x)
""",
        "b.py": """
_quick = QuickLaunch(arguments, "source")
@wp.func
def part(x: float): ...
def make():
    @wp.kernel(module="unique")
    def turn(x: float): ...
    return native.launcher_of("source", lanes=4)
""",
    }
    assert kernels.kernels(sources) == {
        ("a.py", "outer"),
        ("a.py", "other"),
        ("b.py", "_quick"),
        ("b.py", "turn"),
        ("b.py", "make"),
    }
