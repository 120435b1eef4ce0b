"""Fields of config dataclasses are checked against their annotations."""

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import pytest

import ksim_rl
from ksim_rl.checked import Checked, Count, Name, Positive, Range, Share, Within


@dataclass(frozen=True, kw_only=True)
class Inner(Checked):
    size: Count = 1


@dataclass(frozen=True, kw_only=True)
class Outer(Checked):
    gain: Positive = 1.0
    share: Share | None = None
    limits: Range = (0.0, 1.0)
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ends: Annotated[tuple[float, float], Within(low=0.0)] = (1.0, 0.5)
    names: str | tuple[str, ...] = ".*"
    mode: Literal["add", "scale"] = "add"
    title: Name = "run"
    flag: bool = False
    weights: Mapping[str, Positive] | None = None
    inner: Inner = Inner()
    anything: Any = None


GOOD: list[dict[str, Any]] = [
    {},
    {"gain": 2},
    {"share": 0.0},
    {"limits": (1.0, 1.0)},
    {"names": ["a", "b"]},
    {"weights": {"a": 1.0}},
    {"anything": object()},
]
BAD: list[tuple[dict[str, Any], str]] = [
    ({"gain": 0.0}, r"gain=0.0: expected a finite number in \(0.0, inf\)"),
    ({"gain": float("nan")}, r"gain=nan: expected a finite number"),
    ({"gain": "1"}, r"gain='1': expected a number in \(0.0, inf\)"),
    ({"share": 1.5}, r"share=1.5: expected a finite number in \[0.0, 1.0\]"),
    ({"limits": (2.0, 1.0)}, r"limits=\(2.0, 1.0\): low exceeds high"),
    ({"limits": 3.0}, r"limits=3.0: expected a pair"),
    ({"point": (0.0, float("inf"), 0.0)}, r"point\[1\]=inf: expected a finite number"),
    ({"point": (0.0, 0.0)}, r"point=\(0.0, 0.0\): expected 3 entries"),
    ({"ends": (1.0, -0.5)}, r"ends\[1\]=-0.5: expected a finite number in \[0.0, inf\)"),
    ({"names": 3}, r"names=3: expected a text; or names=3: expected a list"),
    ({"names": ("a", 3)}, r"names\[1\]=3: expected a text"),
    ({"mode": "scal"}, r"mode='scal': did you mean 'scale'\?"),
    ({"title": ""}, r"title='': expected a name"),
    ({"title": 3}, r"title=3: expected a text"),
    ({"flag": 1}, r"flag=1: expected true or false"),
    ({"weights": {"a": -1.0}}, r"weights.a=-1.0: expected a finite number in \(0.0, inf\)"),
    ({"weights": [1.0]}, r"weights=\[1.0\]: expected a mapping"),
    ({"inner": 3}, r"inner=3: expected a Inner"),
]


@pytest.mark.parametrize("given", GOOD)
def test_what_annotations_allow_is_taken(given):
    assert Outer(**given).gain > 0


@pytest.mark.parametrize(("given", "message"), BAD)
def test_what_annotations_do_not_allow_is_refused_by_name(given, message):
    with pytest.raises(ValueError, match=message):
        Outer(**given)


@pytest.mark.parametrize("size", [0, -1, 1.0, True])
def test_a_count_is_a_whole_number_of_at_least_one(size):
    with pytest.raises(ValueError, match="size="):
        Inner(size=size)


@pytest.mark.parametrize("group", [6, -1, 1.5, True])
def test_whole_numbers_with_two_bounds_are_whole(group):
    @dataclass(frozen=True, kw_only=True)
    class Groups(Checked):
        group: Annotated[int, Within(low=0, high=5)] = 0

    assert Groups(group=5).group == 5
    with pytest.raises(ValueError, match="group="):
        Groups(group=group)


def _modules():
    for found in pkgutil.walk_packages(ksim_rl.__path__, "ksim_rl."):
        # Adapters need libraries that may be absent.
        if not found.name.startswith("ksim_rl.adapters"):
            yield importlib.import_module(found.name)


def _undeclared(cls: type) -> list[str]:
    """Return the constants of a class that neither it nor a base of it annotates."""
    declared = {name for base in cls.__mro__ for name in inspect.get_annotations(base)}
    constants = {
        name
        for name, value in vars(cls).items()
        if name[0] != "_" and not hasattr(type(value), "__get__")
    }
    return sorted(constants - declared)


def test_constants_of_configs_are_declared_by_a_base():
    # A misspelt one would be ignored in silence.
    configs = {
        kind
        for module in _modules()
        for kind in vars(module).values()
        if isinstance(kind, type) and issubclass(kind, Checked)
    }
    assert len(configs) > 200
    assert {kind.__name__: found for kind in configs if (found := _undeclared(kind))} == {}


def test_a_misspelt_constant_is_found():
    class Named(Checked):
        name: ClassVar[str]

    class Ball(Named):
        nmae = "ball"

    assert _undeclared(Ball) == ["nmae"]


def test_a_subclass_may_give_other_defaults_which_keep_their_place():
    @dataclass(frozen=True, kw_only=True)
    class Sample(Checked):
        weight: Positive = 1.0
        name: str = "sample"

    @dataclass(frozen=True, kw_only=True)
    class Placed(Checked):
        place: str = "here"

    @dataclass(frozen=True, kw_only=True)
    class Heavy(Placed, Sample):
        weight: Positive = 5.0

    assert Heavy() == Heavy(weight=5.0, name="sample", place="here")
    assert Sample().weight == 1.0
    assert [field.name for field in fields(Heavy)] == ["weight", "name", "place"]
    with pytest.raises(ValueError, match=r"weight=-1\.0"):
        Heavy(weight=-1.0)


def test_what_each_class_says_of_several_fields_is_asked_of_all_bases():
    @dataclass(frozen=True, kw_only=True)
    class Span(Checked):
        low: float = 0.0
        high: float = 1.0

        def _check_fields(self) -> None:
            super()._check_fields()
            if self.low > self.high:
                raise ValueError("low exceeds high")

    @dataclass(frozen=True, kw_only=True)
    class Even(Span):
        def _check_fields(self) -> None:
            super()._check_fields()
            if self.high % 2:
                raise ValueError("high is odd")

    with pytest.raises(ValueError, match="low exceeds high"):
        Even(low=3.0, high=2.0)
    with pytest.raises(ValueError, match="high is odd"):
        Even()
    assert Even(high=2.0).high == 2.0


def test_no_check_of_several_fields_leaves_out_those_of_its_bases():
    found = 0
    for path in sorted((Path(ksim_rl.__file__).parent).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef) or node.name != "_check_fields":
                continue
            found += 1
            statements = [ast.unparse(own) for own in node.body]
            is_first = "super()._check_fields()" in statements[:2]
            assert is_first or path.name == "checked.py", (
                f"{path}:{node.lineno}: call super()._check_fields() first"
            )
    assert found > 40
