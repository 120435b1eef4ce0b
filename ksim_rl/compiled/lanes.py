"""Deals the loops of a row out to a few lanes of a warp.

One thread per row leaves most of a GPU idle, and neighboring threads read far apart. Here lanes share the places of a
loop, and wait only where one needs a result of another. Loops of one level need nothing of each other, except for the
same place of the same shape, which the same lane has. Single numbers are computed by all lanes. Sums keep their order.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import NamedTuple

from ksim_rl.compiled.cells import Loop

LANES = {"cpu": 0, "cuda": 8}
"""Lanes of a row by type of device; 0 where one thread does the whole row."""
# One warp, so that `__syncwarp` is all the waiting that lanes of a row need.
BLOCK = 32
DEAL = """
    auto deal = [&](int count, auto body) {
        for (int k = 0; k < count; k += LANES)
            if (k + LANES <= count || k + lane < count) body(k + lane, k / LANES);
    };
    #if defined(__CUDA_ARCH__) && LANES > 1
        #define ARRAY(type, name, size) \\
            __shared__ type name##_of_rows[BLOCK / LANES][size]; auto& name = name##_of_rows[threadIdx.x / LANES];
        #define WAIT __syncwarp();
    #else
        #define ARRAY(type, name, size) type name[size];
        #define WAIT
    #endif
"""
# Three kinds of array: each lane has a copy; the lanes of a row share it; or one register at each place of a lane.
_LONE = "{ctype} {name}[1];"
SHARED = "ARRAY({ctype}, {name}, {size})"
_PRIVATE = "struct {{ {ctype} x; auto& operator[](int) {{ return x; }} }} {name};"


class Own(NamedTuple):
    """An array of a row's own."""

    name: str
    ctype: str
    size: int
    bytes: int


@dataclass(eq=False)
class Work:
    """A loop of the operation with this number, and the names of the arrays that it writes.

    `level` counts the waits before it, and `is_whole` says that each lane does all of it.
    """

    loop: Loop
    operation: int
    written: set[str]
    level: int = 0
    is_whole: bool = False

    def __post_init__(self) -> None:
        self.shape, self.body, elements = self.loop
        # At which places an array is used, as C++ spells them.
        self.texts: dict[str, set[str]] = {}
        for element in elements:
            self.texts.setdefault(element.name, set()).add(element.text)

    def shares(self, name: str, other: "Work") -> bool:
        """Whether both use an array at the same place in the same lane."""
        # With one spelling, and no index that is itself read from an array, equal lanes use equal elements.
        first, *others = self.texts[name] | other.texts[name]
        is_same = prod(self.shape) == 1 or not others and first.count("[") == 1
        return is_same and self.shape == other.shape and not self.is_whole and not other.is_whole

    def follow(self, before: "Work", kinds: Mapping[str, str]) -> None:
        """Raise the level so that this may come after another work."""
        # Read after write, write after write, and write after read.
        names = before.written & self.texts.keys() | self.written & before.texts.keys()
        # Loops of one operation have no order among themselves.
        if names and before.operation != self.operation:
            is_at_once = all(
                before.is_whole if kinds.get(name) == _LONE else before.shares(name, self)
                for name in names
            )
            # A level further where lanes must wait, and the same level where each lane reads its own numbers.
            self.level = max(self.level, before.level + (not is_at_once))


def schedule(works: Sequence[Work], own: Sequence[Own]) -> dict[str, str]:
    """Give all works their levels, and return the kind of array of each of `own`."""
    users = {}
    kinds = {}
    for one in own:
        users[one.name] = [work for work in works if one.name in work.texts]
        kinds[one.name] = _LONE if one.size == 1 else SHARED
    # A single number that is written in a loop of many places would be written by several lanes.
    for work in works:
        if prod(work.shape) > 1:
            kinds |= dict.fromkeys(work.written & kinds.keys(), SHARED)
    for number, work in enumerate(works):
        # A loop that only writes copies of each lane is done by each lane.
        work.is_whole = bool(work.written) and all(
            kinds.get(name) == _LONE for name in work.written
        )
        for before in works[:number]:
            work.follow(before, kinds)
    for name, used in users.items():
        # An array that lives in one level, at one place per lane, needs no memory: a register will do.
        first = used[0]
        is_private = True
        for one in used:
            has_one_place = len(one.texts[name]) == 1
            in_one_level = one.level == first.level
            is_private &= has_one_place and in_one_level and one.shares(name, first)
        if is_private:
            kinds[name] = _PRIVATE
    return kinds


def source(
    works: Sequence[Work],
    own: Sequence[Own],
    kinds: Mapping[str, str],
    read: Mapping[str, str] | None,
) -> Iterator[str]:
    """Write the C++ of a row, with loads of `read`-only numbers first; with None, one lane does everything."""
    declared = {one.name: kinds[one.name].format(**one._asdict()) for one in own}
    yield from (line for name, line in declared.items() if kinds[name] != _PRIVATE)
    yield from () if read is None else _loads(works, read)
    for level in range(max(work.level for work in works) + 1):
        # Within a level: first the loops that every lane does, then the dealt ones, joined by shape.
        here = [work for work in works if work.level == level]
        yield "WAIT"
        yield from (f"{_nest(work.shape)} {{ {work.body} }}" for work in here if work.is_whole)
        # Joined loops let a lane keep intermediate numbers in registers.
        for shape in dict.fromkeys(work.shape for work in here if not work.is_whole):
            dealt = [work for work in here if work.shape == shape and not work.is_whole]
            used = dict.fromkeys(
                name for work in dealt for name in work.texts if kinds.get(name) == _PRIVATE
            )
            yield f"{_nest(shape)} {{" if read is None else _deal(shape)
            yield from (declared[name] for name in used)
            yield from (f"{{ {work.body} }}" for work in dealt)
            yield "}" if read is None else "});"


def _nest(shape: Sequence[int]) -> str:
    return " ".join(f"for (int i{k} = 0; i{k} < {size}; ++i{k})" for k, size in enumerate(shape))


def _deal(shape: Sequence[int]) -> str:
    # The lane gets one running number, and C++ recovers the indices i0, i1, ... from it.
    head = f"deal({prod(shape)}, [&](int i, int turn) {{"
    rest = "i"
    for k, size in reversed(list(enumerate(shape))):
        head += f" const int i{k} = {f'{rest} % {size}' if k else rest};"
        rest += f" / {size}"
    return head


def _loads(works: Sequence[Work], read: Mapping[str, str]) -> Iterator[str]:
    """Load read-only numbers before everything else, as each level would wait for memory again."""
    known: dict[tuple[str, tuple[int, ...]], str] = {}
    for work in works:
        # Longest first, as one element's text may hold another's.
        for _, _, array, text in sorted(work.loop.elements, key=lambda element: -len(element.text)):
            # Only elements whose indices, too, are read-only.
            if (
                text not in work.body
                or not set(re.findall(r"\b(?!row|i\d)[a-z]\w*", text)) <= read.keys()
            ):
                continue
            if re.search(r"\bi\d", text):
                shape = work.shape
            else:
                shape = ()
            if (text, shape) not in known:
                name = known[text, shape] = f"c{len(known)}"
                yield f"{read[array]} {name}[({prod(shape)} + LANES - 1) / LANES];"
                yield (
                    f"{_deal(shape)} {name}[turn] = {text}; }});"
                    if shape
                    else f"{name}[0] = {text};"
                )
            work.body = work.body.replace(text, f"{known[text, shape]}[{'turn' if shape else 0}]")
