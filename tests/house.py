"""Measures the package: `python -m tests.house` prints its rooms and fails where a limit is broken.

`--root DIR` measures another checkout. The limits are those that CONTRIBUTING.md gives.
"""

import argparse
import ast
import io
import re
import sys
import tokenize
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

from tests import density, signatures
from tests.circles import strong_components

PACKAGE = "ksim_rl"
ROOM_SHARE = 0.25
FILE_LINES = 450
FOLDER_FILES = 30
CONTRACT_LINES = 120
PUBLIC_PARAMETERS = 8
PARAMETERS = 12
# Compilers that read a kernel's source: a launch hands it each array and number by itself. So do operators of torch.
KERNELS = re.compile(r"^(wp|warp)\.(kernel|func|func_native)\b|^triton\.jit\b")
VAGUE_NAMES = {"utils", "util", "helpers", "helper", "misc", "common"}
# The groups of docs/architecture.md, from what people use down to what computes; "" is the modules beside the rooms.
OTHERS = "of no group"
GROUPS = {
    "applications": (
        "cli",
        "conf",
        "tasks",
        "tracking",
        "suites",
        "algorithms",
        "trainers",
        "runs",
    ),
    "library": (
        "collectors",
        "objectives",
        "modules",
        "data",
        "mdp",
        "envs",
        "transforms",
        "scene",
        "config",
        "ranks",
        "files",
    ),
    "engine": ("physics", "compiled", "device", ""),
    "tools": (
        "tables",
        "viewer",
        "transfer",
        "zoo",
        "export",
        "diagnosis",
        "identification",
        "clips",
        "testing",
        "adapters",
    ),
}
# Rooms that use envs through envs/contract.py only.
ROOMS_WITHOUT_PROBES = (
    "trainers",
    "collectors",
    "adapters",
    "algorithms",
    "testing",
    "cli",
    "export",
    "viewer",
)
# Folders of tests that belong to no single room.
TESTS_OF_ALL_ROOMS = {"benchmarks", "docs", "examples", "gpu", "integration"}

_PROBED = re.compile(r"env|inner|world", re.IGNORECASE)


@dataclass(frozen=True)
class Folder:
    """Figures of a room."""

    name: str
    files: int
    lines: int
    words: int
    longest: tuple[int, str]
    most_files: tuple[int, str]


class House:
    """A package in a checkout, as its source has it."""

    def __init__(self, checkout: Path):
        self.checkout = checkout
        self.root = checkout / PACKAGE
        if not self.root.is_dir():
            raise ValueError(f"--root {checkout}: there is no folder {PACKAGE} in it")

    @cached_property
    def texts(self) -> dict[Path, str]:
        """The source of each module."""
        return {path: path.read_text() for path in sorted(self.root.rglob("*.py"))}

    @cached_property
    def lines(self) -> dict[Path, int]:
        """Lines of each module."""
        return {path: text.count("\n") for path, text in self.texts.items()}

    def name(self, path: Path) -> str:
        """Return a path inside of the checkout."""
        return str(path.relative_to(self.checkout))

    def room(self, path: Path) -> str:
        """Return the folder under the package that a module lies in, or "" for those beside the rooms."""
        parts = path.relative_to(self.root).parts
        return parts[0] if len(parts) > 1 else ""

    def rooms(self) -> list[Folder]:
        """Return the figures of all rooms, the largest first; "" has the modules beside them."""
        found = []
        for room in {self.room(path) for path in self.texts}:
            paths = [path for path in self.texts if self.room(path) == room]
            in_folder = {
                path.parent: sum(other.parent == path.parent for other in paths) for path in paths
            }
            most = max(in_folder, key=lambda folder: in_folder[folder])
            longest = max(paths, key=lambda path: self.lines[path])
            found.append(
                Folder(
                    room,
                    len(paths),
                    sum(self.lines[path] for path in paths),
                    sum(words_of_code(self.texts[path]) for path in paths),
                    (self.lines[longest], self.name(longest)),
                    (in_folder[most], self.name(most)),
                )
            )
        return sorted(found, key=lambda folder: -folder.lines)

    def circles(self) -> list[list[str]]:
        """Return the groups of modules that import each other; imports for type checkers and in functions count."""
        modules = {self._module(path): path for path in self.texts}
        imports = {
            name: sorted(self._imports(name, path, modules)) for name, path in modules.items()
        }
        return [sorted(group) for group in strong_components(imports) if len(group) > 1]

    def _module(self, path: Path) -> str:
        parts = path.relative_to(self.checkout).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def _imports(self, name: str, path: Path, modules: dict[str, Path]) -> Iterator[str]:
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for node in signatures.nodes(self.texts[path]):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names if alias.name in modules)
            elif isinstance(node, ast.ImportFrom):
                base = node.module or ""
                if node.level:
                    parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                    base = ".".join([*parents, *filter(None, [base])])
                for alias in node.names:
                    target = f"{base}.{alias.name}" if f"{base}.{alias.name}" in modules else base
                    if target in modules and target != name:
                        yield target


@cache
def words_of_code(text: str) -> int:
    """Return the number of names, keywords, numbers and strings, without comments and docstrings."""
    docstrings = signatures.docstring_lines(text)
    kinds = (tokenize.NAME, tokenize.NUMBER, tokenize.STRING)
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(
        token.type in kinds and not (token.type == tokenize.STRING and token.start[0] in docstrings)
        for token in tokens
    )


# ---- limits: each returns what breaks it ----


def room_shares(house: House) -> list[str]:
    """Return rooms with too large a share."""
    total = sum(house.lines.values())
    shares = {room.name: room.lines / total for room in house.rooms() if room.name}
    return [
        f"{name} has {share:.1%} of the lines"
        for name, share in shares.items()
        if share > ROOM_SHARE
    ]


def file_lengths(house: House) -> list[str]:
    """Return files that are too long."""
    return [
        f"{house.name(path)} has {n} lines" for path, n in house.lines.items() if n > FILE_LINES
    ]


def folder_sizes(house: House) -> list[str]:
    """Return folders with too many files."""
    folders = [folder for folder in (house.root, *house.root.rglob("*")) if folder.is_dir()]
    counts = {f: sum(p.is_file() and p.suffix != ".pyc" for p in f.iterdir()) for f in folders}
    return [f"{house.name(f)} has {n} files" for f, n in counts.items() if n > FOLDER_FILES]


def vague_names(house: House) -> list[str]:
    """Return modules and folders whose names say nothing."""
    paths = {
        part for path in house.texts for part in (path, *path.parents) if house.root in part.parents
    }
    return sorted(house.name(path) for path in paths if path.stem.strip("_") in VAGUE_NAMES)


def circles(house: House) -> list[str]:
    """Return the circles of imports."""
    return [" <-> ".join(circle) for circle in house.circles()]


def contract_size(house: House) -> list[str]:
    """Return what is wrong with the contract's file."""
    path = house.root / "envs" / "contract.py"
    if not path.is_file():
        return [f"{house.name(path)} is missing"]
    n = house.lines[path]
    return (
        [f"{house.name(path)} has {n} lines: {CONTRACT_LINES} at most"]
        if n > CONTRACT_LINES
        else []
    )


def bare_tensors(house: House) -> list[str]:
    """Return tensors of public functions without named axes."""
    return signatures.bare_tensors(house.root)


def suffixes(house: House) -> list[str]:
    """Return names that do not carry their dims, and models under other names."""
    return signatures.wrong_names(house.root)


def probes(house: House) -> list[str]:
    """Return the places where a room finds out what an env has, other than through the contract."""
    return [
        f"{house.name(path)}:{node.lineno} {ast.unparse(node).splitlines()[0]}"
        for path, text in house.texts.items()
        if house.room(path) in ROOMS_WITHOUT_PROBES
        for node in signatures.nodes(text)
        if _is_probe(node)
    ]


def _is_probe(node: ast.AST) -> bool:
    if isinstance(node, ast.ExceptHandler):
        return node.type is not None and "AttributeError" in ast.unparse(node.type)
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
        return False
    asks = node.func.id == "hasattr" or (node.func.id == "getattr" and len(node.args) == 3)
    return asks and bool(_PROBED.search(ast.unparse(node.args[0])))


def tests_in_place(house: House) -> list[str]:
    """Return rooms without tests, folders of tests without a room, and tests that lie beside another room's."""
    tests = house.checkout / "tests"
    rooms = {room.name for room in house.rooms() if room.name}
    folders = {path.name for path in tests.iterdir() if path.is_dir() and any(path.rglob("*.py"))}
    found = [f"tests/{room} is missing" for room in sorted(rooms - folders)]
    found += [
        f"tests/{name} is of no room" for name in sorted(folders - rooms - TESTS_OF_ALL_ROOMS)
    ]
    rooms_of: dict[str, set[str]] = {}
    folders_of: dict[str, set[str]] = {}
    for path in house.texts:
        rooms_of.setdefault(path.stem, set()).add(house.room(path))
        folders_of.setdefault(path.parent.name, set()).add(house.room(path))
    for path in sorted(tests.rglob("test_*.py")):
        room = path.relative_to(tests).parts[0]
        subject = path.stem.removeprefix("test_")
        homes = rooms_of.get(subject, set())
        if room in rooms and homes and room not in homes | folders_of.get(subject, set()):
            found.append(f"{house.name(path)} tests a module of {', '.join(sorted(homes))}")
    return found


def crammed(house: House) -> list[str]:
    """Return statements that hold two or more comprehensions, ternaries or lambdas."""
    return [f"{house.name(path)}:{line}" for path, line in density.crammed(house.texts)]


def long_signatures(house: House) -> list[str]:
    """Return functions with more parameters than a caller can keep in mind."""
    found = []
    for path, text in house.texts.items():
        operators = _operators(text)
        for function in signatures.functions(path, house.root):
            if function.name in operators:
                continue
            if any(KERNELS.match(ast.unparse(decorator)) for decorator in function.decorators):
                continue
            most = PUBLIC_PARAMETERS if function.public else PARAMETERS
            if function.arguments > most:
                found.append(
                    f"{function.place} {function.name} has {function.arguments}: {most} at most"
                )
    return found


def _operators(text: str) -> set[str]:
    """Return the names of functions that a module makes operators of torch, whose schemas are flat."""
    calls = [node for node in signatures.nodes(text) if isinstance(node, ast.Call)]
    made = [
        call for call in calls if isinstance(call.func, ast.Name) and call.func.id == "as_operator"
    ]
    given = [
        part
        for call in made
        for part in (*call.args, *(keyword.value for keyword in call.keywords))
    ]
    return {part.id for part in given if isinstance(part, ast.Name)}


def means(house: House) -> list[str]:
    """Return the means over the package that rose above what they have been."""
    found = []
    tokens = density.tokens_per_line(house.texts)
    if tokens > density.TOKENS_PER_LINE:
        found.append(
            f"{tokens:.2f} tokens in a line of code, and not {density.TOKENS_PER_LINE} or less"
        )
    anys = density.any_per_function(house.texts)
    if anys > density.ANY_PER_FUNCTION:
        found.append(
            f"`Any` {anys:.3f} times per function, and not {density.ANY_PER_FUNCTION} or less"
        )
    return found


LIMITS: dict[str, Callable[[House], list[str]]] = {
    f"no room has more than {ROOM_SHARE:.0%} of the lines": room_shares,
    f"no file has more than {FILE_LINES} lines": file_lengths,
    f"no folder has more than {FOLDER_FILES} files": folder_sizes,
    "names say what is inside": vague_names,
    "modules do not import each other in circles": circles,
    f"envs/contract.py has at most {CONTRACT_LINES} lines": contract_size,
    "tensors of public functions have named axes": bare_tensors,
    "tensor names carry their dims": suffixes,
    "rooms ask the contract what an env has": probes,
    "tests lie where their modules do": tests_in_place,
    "no statement holds two comprehensions, ternaries or lambdas": crammed,
    f"functions have at most {PARAMETERS} parameters, public ones {PUBLIC_PARAMETERS}": long_signatures,
    "code gets no denser, and no less typed": means,
}


def group_of(room: str) -> str:
    """Return the group that a room belongs to."""
    for group, rooms in GROUPS.items():
        if room in rooms:
            return group
    return OTHERS


def report(house: House, most: int) -> tuple[str, bool]:
    """Return the table of rooms and the broken limits with at most `most` findings each, and whether all hold."""
    rooms = house.rooms()
    total = sum(room.lines for room in rooms)
    row = "{:<13}{:>6}{:>8}{:>7}{:>9}  {:>4}  {}"
    lines = [row.format("room", "files", "lines", "share", "words", "most", "longest file")]
    for group in sorted({group_of(room.name) for room in rooms}, key=[*GROUPS, OTHERS].index):
        lines.append(f"-- {group}")
        for room in rooms:
            if group_of(room.name) != group:
                continue
            name = room.name or "(beside)"
            longest = f"{room.longest[0]} {room.longest[1]}"
            cells = (name, room.files, room.lines, f"{room.lines / total:.1%}", room.words)
            lines.append(row.format(*cells, room.most_files[0], longest))
    words = sum(room.words for room in rooms)
    longest = max(room.longest for room in rooms)
    most_files = max(room.most_files for room in rooms)
    total_cells = (sum(room.files for room in rooms), total, "100%", words, most_files[0])
    lines.append(row.format("all", *total_cells, f"{longest[0]} {longest[1]}"))
    lines.append("(words: names, numbers and strings of code; most: files in the fullest folder)\n")
    holds = True
    for limit, check in LIMITS.items():
        broken = check(house)
        holds = holds and not broken
        lines.append(
            f"{'FAILS' if broken else 'holds'}: {limit}"
            + (f" ({len(broken)} do not)" if broken else "")
        )
        lines += [f"    {finding}" for finding in broken[:most]]
        if len(broken) > most:
            lines.append(f"    ... and {len(broken) - most} more: --most {len(broken)} shows them")
    return "\n".join(lines), holds


def main(arguments: list[str] | None = None) -> int:
    """Print the report; 1 where a limit is broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.house", description=__doc__)
    parser.add_argument(
        "--root", type=Path, default=Path(__file__).parents[1], help="checkout to measure"
    )
    parser.add_argument(
        "--most", type=int, default=8, help="findings to show for each broken limit"
    )
    options = parser.parse_args(arguments)
    text, holds = report(House(options.root.resolve()), options.most)
    print(text)
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
