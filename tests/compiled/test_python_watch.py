"""A watch names each Python value that has changed, wherever an object finds it, and nothing else."""

import functools
import random
import types
import weakref
from collections import deque
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from torch import nn

from ksim_rl.compiled.python_values import MOST_ITEMS, Listed
from ksim_rl.compiled.python_watch import PythonWatch, listed

CPU = torch.device("cpu")
LIMIT = {"low": 1.0}
shared = types.SimpleNamespace(level=1)


def watched(device=CPU, **parts):
    watch = PythonWatch(device)
    watch.look(parts)
    return watch


def names(watch):
    return [name for change in watch.changes() for name in change.names]


class Slotted:
    __slots__ = ("held",)

    def __init__(self):
        self.held = 1


class Base:
    factor = 1.0

    def __init__(self, **given):
        vars(self).update(given)

    def __call__(self):
        return self.factor * LIMIT["low"] * self.nested()

    def nested(self):
        return sum(weight() for weight in [lambda: shared.level])

    @property
    def size(self):
        return len(BIG)


BIG = [1, 2]


class Child(Base):
    pass


@dataclass(frozen=True)
class Settings:
    table: dict = field(default_factory=dict)


def closing_over(value):
    def read():
        return value

    def write(new):
        nonlocal value
        value = new

    return read, write


def test_nothing_has_changed_as_long_as_nothing_changes():
    part = Base(
        a=1,
        b=[1.0, "x"],
        c={"k": (1, 2)},
        d=torch.zeros(3),
        e=np.ones(3),
        f=float("nan"),
        g=Slotted(),
    )
    watch = watched(part=part)
    part.d.add_(1.0)  # recordings read tensors at each replay
    part.a, part.c["k"] = 1, (1, 2)
    assert watch.changes() == []


CHANGES = {
    "part.a": lambda part: setattr(part, "a", 2),
    "part.new": lambda part: setattr(part, "new", 2),
    "part.gone": lambda part: delattr(part, "gone"),
    "part.numbers[1]": lambda part: part.numbers.append(2),
    "part.queue[0]": lambda part: part.queue.rotate(),
    "part.table['k'][0]": lambda part: part.table["k"].__setitem__(0, 5),
    "part.pair[1][0]": lambda part: part.pair[1].__setitem__(0, 5),
    "part.array.content": lambda part: part.array.__setitem__(1, 5.0),
    "part.tensor": lambda part: setattr(part, "tensor", part.tensor.clone()),
    "part.slotted.held": lambda part: setattr(part.slotted, "held", 2),
    "part.settings.table['x']": lambda part: part.settings.table.__setitem__("x", 1),
    "part.read: value in the closure of closing_over.<locals>.read": lambda part: part.write(2),
    "part.partial[0][0]": lambda part: part.partial.args[0].__setitem__(0, 5),
    "part.generator.place": lambda part: next(part.generator),
    "part.iterator.place": lambda part: next(part.iterator),
    "part.random.state": lambda part: part.random.random(),
    "part.numpy.state": lambda part: part.numpy.random(),
    "part.network.weight": lambda part: setattr(part.network, "weight", nn.Parameter(torch.zeros(2, 2))),
    "part.network.training": lambda part: part.network.eval(),
    "part.weak.a": lambda part: setattr(part.weak(), "a", 2),
    "part: Base.factor": lambda part: setattr(Base, "factor", 2.0),
    "part: Base.__call__: global tests.compiled.test_python_watch.LIMIT['low']": lambda part: LIMIT.update(low=2.0),
    "part: Base.size: global tests.compiled.test_python_watch.BIG[2]": lambda part: BIG.append(3),
    "part: Base.nested: global tests.compiled.test_python_watch.shared": lambda part: globals().update(shared=None),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_is_named_by_where_it_is(name, monkeypatch):
    monkeypatch.setattr(Base, "factor", 1.0)
    monkeypatch.setitem(LIMIT, "low", 1.0)
    monkeypatch.setitem(globals(), "BIG", [1, 2])
    monkeypatch.setitem(globals(), "shared", shared)
    numbers, other = [1], Base(a=1)
    read, write = closing_over(1)
    part = Child(
        a=1,
        gone=1,
        numbers=numbers,
        queue=deque([1, 2]),
        table={"k": [1]},
        pair=(1, [2]),
        array=np.zeros(3),
        tensor=torch.zeros(3),
        slotted=Slotted(),
        settings=Settings(),
        read=read,
        write=write,
        partial=functools.partial(max, [1]),
        generator=(number for number in [1, 2, 3]),
        iterator=iter([1, 2, 3]),
        random=random.Random(0),
        numpy=np.random.default_rng(0),
        network=nn.Linear(2, 2),
        weak=weakref.ref(other),
    )
    watch = watched(part=part)
    CHANGES[name](part)
    assert name in names(watch)


def test_an_object_that_several_parts_read_is_named_for_each():
    both = [1]
    watch = watched(one=Base(memory=both), other=Base(memory=both))
    both.append(2)
    (change,) = watch.changes()
    assert str(change) == "one.memory[1] and other.memory[1] was (absent) and is 2"


def test_a_part_is_not_entered_from_another_one():
    inner = Base(a=1)
    watch = watched(outer=Base(inner=inner), inner=inner)
    inner.a = 2
    assert names(watch) == ["inner.a"]


def test_a_listed_part_depends_on_what_it_lists():
    object_ = Base(a=1, b=1)
    watch = watched(part=Listed(object_, lambda: {"a": object_.a}), other=Base(held=object_))
    object_.b = 2
    assert names(watch) == []
    object_.a = 2
    assert names(watch) == ["part.a"]


def test_without_its_code_a_part_depends_on_its_data_alone():
    part = Base(a=[1])
    watch = watched(part=Listed(part, lambda: vars(part), reads_code=False))
    LIMIT["low"] = 3.0
    assert names(watch) == []
    LIMIT["low"] = 1.0
    part.a[0] = 2
    assert names(watch) == ["part.a[0]"]


def test_numbers_of_a_tensor_count_where_recordings_do_not_read_them():
    part = Base(scale=torch.tensor(1.0))
    on_cpu, on_gpu = watched(part=part), watched(torch.device("cuda"), part=part)
    part.scale.fill_(2.0)
    assert (names(on_cpu), names(on_gpu)) == ([], ["part.scale.version"])


def test_of_a_large_container_the_length_is_looked_at():
    part = Base(many=list(range(MOST_ITEMS + 1)))
    watch = watched(part=part)
    part.many[3] = -1
    assert names(watch) == []
    part.many.append(1)
    assert names(watch) == ["part.many.length"]


def test_a_text_lists_some_changes_and_counts_the_others():
    part = Base(**{f"a{index}": 0 for index in range(6)})
    watch = watched(part=part)
    for index in range(6):
        setattr(part, f"a{index}", 1)
    text = listed(watch.changes())
    assert text.startswith("part.a0 was 0 and is 1; part.a1") and text.endswith("; and 2 more")


def test_what_looks_alike_is_another_object():
    part = Base(network=nn.Linear(2, 2))
    watch = watched(part=part)
    part.network = nn.Linear(2, 2)
    assert listed(watch.changes()) == "part.network is another object"


def test_looking_again_forgets_what_was():
    part = Base(a=1)
    watch = watched(part=part)
    part.a = 2
    watch.look({"part": part})
    assert watch.changes() == []
