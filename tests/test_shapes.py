"""The axes in annotations are enforced while the tests run, and no function with axes is left out."""

import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Mapping

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float, Float32, Int, Shaped, TypeCheckError
from torch import Tensor

from tests import annotations, shapes, signatures


def _dot(
    a_EL: Float[Tensor, "E L"], b_EL: Float[Tensor, "E L"], *, scale: float = 1.0
) -> Float[Tensor, " E"]:
    return scale * (a_EL * b_EL).sum(-1)


def _dropped_row(a_EL: Float[Tensor, "E L"]) -> Float[Tensor, " E"]:
    return a_EL.sum(-1)[1:]


def _checked(function):
    return shapes.checked(function, *(name for name in function.__annotations__ if name != "scale"))


def _accepts(annotation, value, sizes=None):
    return not annotations.check_of(annotation)(value, {} if sizes is None else sizes)


def test_a_wrong_shape_is_an_error():
    dot = _checked(_dot)
    assert dot(torch.ones(2, 3), b_EL=torch.ones(2, 3), scale=2.0).tolist() == [6.0, 6.0]
    with pytest.raises(TypeCheckError, match=r"_dot: argument b_EL has shape \(2, 4\).*E=2, L=3"):
        dot(torch.ones(2, 3), torch.ones(2, 4))
    with pytest.raises(TypeCheckError, match="torch.int64"):
        dot(torch.ones(2, 3), torch.ones(2, 3, dtype=torch.int64))
    with pytest.raises(TypeCheckError, match=r"its result has shape \(1,\)"):
        _checked(_dropped_row)(torch.ones(2, 3))


@pytest.mark.parametrize(
    "annotation, right, wrong",
    [
        (Float[Tensor, ""], torch.ones(()), torch.ones(1)),
        (Float[Tensor, "E 1"], torch.ones(4, 1), torch.ones(4)),
        (Float32[Tensor, " E"], torch.ones(4), torch.ones(4, dtype=torch.float64)),
        (Bool[Tensor, " E"], torch.ones(4, dtype=torch.bool), torch.ones(4)),
        (Int[np.ndarray, "E 3"], np.ones((4, 3), dtype=np.int32), np.ones((4, 3))),
        (Shaped[Tensor, "*batch 3"], torch.ones(4, 5, 3), torch.ones(3, 4)),
        (Shaped[Tensor, "E L+1"], torch.ones(4, 6), torch.ones(4, 5)),
        (Float[Tensor, " E"] | None, None, 1.0),
        (Float[Tensor, " E"] | float, 1.0, torch.ones(5)),
        (
            Mapping[str, Float[Tensor, " E"]],
            {"a": torch.ones(4)},
            {"a": torch.ones(4), "b": torch.ones(5)},
        ),
        (dict[str, Float[Tensor, " E"]], {}, [torch.ones(4)]),
        (
            dict[str, Float[Tensor, "E ?L"]],
            {"a": torch.ones(4, 2), "b": torch.ones(4, 3)},
            {"a": torch.ones(4, 2), "b": torch.ones(5, 3)},
        ),
        (
            dict[str, Float[Tensor, "E *?leaf"]],
            {"a": torch.ones(4, 2), "b": torch.ones(4)},
            {"a": torch.ones(4, 2), "b": torch.ones(5)},
        ),
        (list[Float[Tensor, " E"]], [torch.ones(4)], [torch.ones(4), torch.ones(3)]),
        (
            tuple[Float[Tensor, " E"], Float[Tensor, " L"]],
            (torch.ones(4), torch.ones(5)),
            (torch.ones(4),),
        ),
        (tuple[Float[Tensor, " E"], ...], (torch.ones(4),) * 3, (torch.ones(4), torch.ones(3))),
    ],
)
def test_annotations(annotation, right, wrong):
    assert _accepts(annotation, right, {"E": 4, "L": 5})
    assert not _accepts(annotation, wrong, {"E": 4, "L": 5})


def test_an_alternative_that_does_not_fit_binds_no_axis():
    sizes = {}
    assert _accepts(Float[Tensor, "E 3"] | Float[Tensor, "L 2"], torch.ones(4, 2), sizes)
    assert sizes == {"L": 4}


def test_compiled_code_calls_through():
    dot = _checked(_dot)
    compiled = torch.compile(lambda a_EL: dot(a_EL, a_EL), fullgraph=True, backend="eager")
    assert compiled(torch.ones(2, 3)).tolist() == [3.0, 3.0]


_SOURCE = '''
"""A module of the package, as the loader sees it."""
from __future__ import annotations
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING
from torch import Tensor
import torch
import types
from jaxtyping import Float
triton = types.SimpleNamespace(jit=lambda function: function)
if TYPE_CHECKING:
    from nowhere import Unknown
    from jaxtyping import Int

def plain(value: int) -> int:
    return value

@functools.cache
def cached(size: int) -> Float[Tensor, " L"]:
    return torch.ones(size + 1, 2)

class Owner:
    class Inner:
        @property
        def vector(self) -> Float[Tensor, "E 3"]:
            return torch.ones(2, 4)

    @classmethod
    def made(cls, a_E: Float[Tensor, " E"], other: Unknown | None = None) -> Owner:
        return cls()

    @staticmethod
    def summed(*parts_E: Float[Tensor, " E"]) -> None: ...

    def later(self, b: Later) -> None: ...

    def rows(self, a_E: Float[Tensor, " E"]) -> Iterator[Float[Tensor, " E"]]:
        yield a_E

@dataclass(frozen=True)
class Pair:
    a_E: Float[Tensor, " E"]
    b_E: Float[Tensor, " E"]
    def __call__(self) -> Float[Tensor, "E 1"]:
        return self.a_E

class Child(Owner):
    def later(self, b_E: Float[Tensor, " E"]) -> None: ...

@triton.jit
def kernel(a: Float): ...

def unknown(a_E: Int[Tensor, " E"]) -> None: ...
'''


@pytest.fixture
def loaded(tmp_path):
    """Load `_SOURCE` as a module of the package."""
    path = tmp_path / "loaded.py"
    path.write_text(_SOURCE)
    before = dict(shapes.WRAPPED)
    loader = shapes.ShapeCheckingLoader("loaded", str(path))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("loaded", loader))
    sys.modules["loaded"] = module  # dataclasses look there
    try:
        loader.exec_module(module)
        yield module
    finally:
        del sys.modules["loaded"]
        for name in shapes.WRAPPED.keys() - before.keys():
            del shapes.WRAPPED[name]
        shapes.FOREIGN.remove("loaded.kernel")


@pytest.mark.parametrize(
    "call",
    [
        lambda module: module.cached(3),
        lambda module: module.Owner.Inner().vector,
        lambda module: module.Owner.made(torch.ones(2, 2)),
        lambda module: module.Owner.summed(torch.ones(2), torch.ones(2, 2)),
        lambda module: module.Child().later(torch.ones(2, 2)),
        lambda module: module.Pair(torch.ones(2), torch.ones(3)),
        lambda module: module.Pair(torch.ones(2), torch.ones(2))(),
        lambda module: list(module.Owner().rows(torch.ones(2, 2))),
    ],
    ids=[
        "cache",
        "property",
        "classmethod",
        "varargs",
        "override",
        "dataclass field",
        "dataclass call",
        "generator",
    ],
)
def test_every_kind_of_function_is_checked(loaded, call):
    with pytest.raises(TypeCheckError):
        call(loaded)


def test_right_calls_pass_and_what_another_compiler_reads_stays_itself(loaded):
    assert not hasattr(loaded.kernel, "__wrapped__")
    assert not hasattr(loaded.plain, "__wrapped__")
    assert hasattr(loaded.Owner.made, "__wrapped__")
    assert loaded.Owner.made(torch.ones(2)).later(3) is None
    loaded.Owner.summed(torch.ones(2), torch.ones(2))
    loaded.Child().later(torch.ones(2))
    loaded.Pair(torch.ones(2), torch.ones(2))
    assert len(list(loaded.Owner().rows(torch.ones(2)))) == 1


def test_an_annotation_that_cannot_be_evaluated_is_listed(loaded):
    (error,) = [shaped.error for shaped in shapes.WRAPPED.values() if shaped.error]
    assert error.startswith("loaded.unknown: a_E") and "Int" in error


@pytest.fixture(scope="module")
def package():
    """Import every module of the package."""
    import ksim_rl

    for found in pkgutil.walk_packages(ksim_rl.__path__, "ksim_rl."):
        importlib.import_module(found.name)


def test_no_function_of_the_package_is_left_out(package, record_property):
    """The source says which functions there are: all that name axes are checked, but for those that others compile."""
    errors = [shaped.error for shaped in shapes.WRAPPED.values() if shaped.error]
    assert not errors, "\n".join(errors)
    with_axes, foreign, without = set(), set(), set()
    for path in shapes.ROOT.rglob("*.py"):
        module = ".".join(path.relative_to(shapes.ROOT.parent).with_suffix("").parts).removesuffix(
            ".__init__"
        )
        for function in signatures.functions(path, shapes.ROOT):
            if function.is_class or function.is_nested:
                continue
            named = any(signatures.has_axes(annotation) for _, annotation in function.parameters)
            is_foreign = any(map(shapes.is_foreign, function.decorators))
            (foreign if is_foreign else with_axes if named else without).add(
                f"{module}.{function.name}"
            )
    wrapped = {shaped.name for shaped in shapes.WRAPPED.values()}
    assert with_axes <= wrapped, f"not checked: {sorted(with_axes - wrapped)}"
    counts = {
        "checked": len(wrapped),
        "compiled by Warp or Triton": len(foreign),
        "without axes": len(without - wrapped),
    }
    print("functions of ksim_rl:", counts)
    record_property("functions", counts)
    assert len(wrapped) > 250 and len(foreign) > 20


def _wrong_call(shaped):
    """Return arguments for a function of the package; one of them has an axis too many."""
    signature = inspect.signature(shaped.function)
    values = dict.fromkeys(signature.parameters)
    wrong, _ = shaped.arguments[0]
    return values | {wrong: torch.ones(1, 1, 1, 1, 1, 1, 1)}, wrong


def test_twenty_functions_of_the_package_refuse_a_wrong_shape(package):
    """One from each room in turn, from all over the package."""
    by_room = {}
    for shaped in shapes.WRAPPED.values():
        plain = all(
            p.kind is p.POSITIONAL_OR_KEYWORD
            for p in inspect.signature(shaped.function).parameters.values()
        )
        if shaped.arguments and plain and not shaped.name.startswith("loaded"):
            by_room.setdefault(shaped.name.split(".")[1], []).append(shaped)
    refused = 0
    for shapeds in by_room.values():
        for shaped in shapeds[:4]:
            values, wrong = _wrong_call(shaped)
            if "*" in str(shaped.function.__annotations__[wrong]):
                continue
            with pytest.raises(TypeCheckError, match=f"argument {wrong} "):
                shapes.checked(shaped.function, *shaped.parameters)(**values)
            refused += 1
    assert refused >= min(20, len(by_room))
