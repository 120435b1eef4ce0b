"""Reads the source of a package for the axes of its public functions, and for names that do not agree."""

import ast
import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jaxtyping

DTYPES = {
    name
    for name, kind in vars(jaxtyping).items()
    if isinstance(kind, type) and issubclass(kind, jaxtyping.AbstractDtype)
}
_RECEIVERS = {"self", "cls", "ctx"}
_PUBLIC_MAGIC = {"__call__", "__init__"}
_TIMESTAMP = re.compile(r"_t(_plus_1|_minus_1|_0|_f)?$")
_SUFFIX = re.compile(r"_([A-Z0-9]+)$")
_MODELS = {
    "mj_model": re.compile(r"\b(mujoco|mj)\.MjModel\b|^MjModel\b"),
    "warp_model": re.compile(r"\b(mjw|mujoco_warp)\.Model\b"),
    "warp_data_E": re.compile(r"\b(mjw|mujoco_warp)\.Data\b"),
}
_MAKERS = {
    "mj_model": re.compile(r"^(mujoco|mj)\.MjModel\.from_|\bspec\.compile\(\)$"),
    "warp_model": re.compile(r"^(mjw|mujoco_warp)\.put_model\("),
    "warp_data_E": re.compile(r"^(mjw|mujoco_warp)\.(put|make)_data\("),
}
# Names that an interface of another library prescribes.
PRESCRIBED = {"episode_length_buf"}


@dataclass(frozen=True)
class Function:
    """A function of the package, or a class with its annotated fields as parameters."""

    place: str
    """path:line of the definition."""
    name: str
    public: bool
    parameters: tuple[tuple[str, ast.expr], ...]
    """Names with annotations; `return` last."""
    is_property: bool = False
    is_class: bool = False
    is_nested: bool = False
    """Inside of a function: it exists while that one runs."""
    decorators: tuple[ast.expr, ...] = ()
    arguments: int = 0
    """How many it takes, without `self`, `cls` and `ctx`; gathered ones (`*a`, `**b`) count once each."""


def parse(text: str) -> ast.Module:
    """Parse source once."""
    return _parse(text)


@functools.cache
def nodes(text: str) -> tuple[ast.AST, ...]:
    """Return all nodes of a source, which several checks look through."""
    return tuple(ast.walk(parse(text)))


@functools.cache
def docstring_lines(text: str) -> frozenset[int]:
    """Return the numbers of the lines that docstrings stand in."""
    lines: set[int] = set()
    for node in nodes(text):
        is_documented = isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        )
        if is_documented and ast.get_docstring(node, clean=False) is not None:
            docstring = node.body[0]
            lines.update(range(docstring.lineno, (docstring.end_lineno or 0) + 1))
    return frozenset(lines)


@functools.cache
def _parse(text: str) -> ast.Module:
    return ast.parse(text)


def functions(path: Path, root: Path) -> Iterator[Function]:
    """Yield all functions of a file, with those inside of others and the fields of classes."""
    yield from _functions(
        parse(path.read_text()).body, str(path.relative_to(root)), [], True, False
    )


def _functions(
    body: list[ast.stmt], path: str, scope: list[str], public: bool, nested: bool
) -> Iterator[Function]:
    for node in body:
        if isinstance(node, ast.If | ast.Try | ast.With):
            inner = [*node.body, *getattr(node, "orelse", ())]
            yield from _functions(inner, path, scope, public, nested)
        elif isinstance(node, ast.ClassDef):
            shown = public and not node.name.startswith("_")
            fields = tuple(
                (part.target.id, part.annotation)
                for part in node.body
                if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name)
            )
            name = ".".join([*scope, node.name])
            yield Function(f"{path}:{node.lineno}", name, shown, fields, is_class=True)
            yield from _functions(node.body, path, [*scope, node.name], shown, nested)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
            arguments = node.args
            parts = [
                *arguments.posonlyargs,
                *arguments.args,
                arguments.vararg,
                *arguments.kwonlyargs,
                arguments.kwarg,
            ]
            parameters = [
                (part.arg, part.annotation)
                for part in parts
                if part is not None and part.annotation
            ]
            if node.returns is not None:
                parameters.append(("return", node.returns))
            yield Function(
                f"{path}:{node.lineno}",
                ".".join([*scope, node.name]),
                public and (not node.name.startswith("_") or node.name in _PUBLIC_MAGIC),
                tuple(parameters),
                is_property=any(
                    d in ("property", "cached_property", "quantity") for d in decorators
                ),
                is_nested=nested,
                decorators=tuple(node.decorator_list),
                arguments=sum(part is not None and part.arg not in _RECEIVERS for part in parts),
            )
            yield from _functions(node.body, path, [*scope, node.name], False, True)


def aliases(root: Path) -> set[str]:
    """Return names that modules give to annotations with tensors that have no axes."""
    return {
        target.id
        for path in root.rglob("*.py")
        for node in parse(path.read_text()).body
        if isinstance(node, ast.Assign | ast.AnnAssign)
        and isinstance(node.value, ast.Subscript | ast.BinOp | ast.Name)
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if isinstance(target, ast.Name) and is_bare(node.value, set())
    }


def is_bare(annotation: ast.expr, bare_aliases: set[str]) -> bool:
    """Say whether a tensor without named axes stands in `annotation`."""
    if isinstance(annotation, ast.Subscript) and _last_name(annotation.value) in DTYPES:
        array, axes = (
            annotation.slice.elts if isinstance(annotation.slice, ast.Tuple) else (None, None)
        )
        named = (
            isinstance(axes, ast.Constant)
            and isinstance(axes.value, str)
            and "..." not in axes.value
        )
        return (
            not named or _last_name(array) == "Any" or re.search(r"(^|\s)_", axes.value) is not None
        )
    if isinstance(annotation, ast.Constant) and isinstance(annotation.value, str):
        try:
            return is_bare(ast.parse(annotation.value, mode="eval").body, bare_aliases)
        except SyntaxError:
            return False
    if isinstance(annotation, ast.Name | ast.Attribute):
        return _last_name(annotation) == "Tensor" or _last_name(annotation) in bare_aliases
    return any(
        is_bare(part, bare_aliases)
        for part in ast.iter_child_nodes(annotation)
        if isinstance(part, ast.expr)
    )


def arrays(annotation: ast.expr) -> list[str]:
    """Return the axes of the arrays in `annotation`: one for `Float[...] | None`, none inside of containers."""
    if isinstance(annotation, ast.BinOp):
        return [*arrays(annotation.left), *arrays(annotation.right)]
    if isinstance(annotation, ast.Subscript) and _last_name(annotation.value) in DTYPES:
        axes = annotation.slice.elts[1] if isinstance(annotation.slice, ast.Tuple) else None
        return (
            [axes.value] if isinstance(axes, ast.Constant) and isinstance(axes.value, str) else []
        )
    return []


def has_axes(annotation: ast.expr) -> bool:
    """Say whether an array with axes stands anywhere in `annotation`."""
    return any(
        isinstance(part, ast.Subscript) and _last_name(part.value) in DTYPES
        for part in ast.walk(annotation)
    )


def suffix_agrees(name: str, axes: str) -> bool:
    """Say whether a name ends as its axes want: `qpos_EL` for "E L", `mean_E3` for "E 3", none for scalars.

    A timestamp may follow. TorchRL's trailing one need not be spelled: "E T 1" may end in `_ET`. A leaf of known size
    may be called L: a position is `pos_EL` or `pos_E3`.
    """
    found = _SUFFIX.search(_TIMESTAMP.sub("", name))
    suffix = found.group(1) if found else ""
    parts = axes.split()
    if any(not part.isalnum() for part in parts):  # *batch, #E, T+1
        return True
    wanted = "".join(parts).upper()
    allowed = {wanted, wanted[:-1]} if len(parts) > 1 and parts[-1] == "1" else {wanted}
    if parts and parts[-1].isdecimal():
        allowed.add("".join(parts[:-1]).upper() + "L")
    return suffix in allowed


def bare_tensors(root: Path) -> list[str]:
    """Return the arguments and results of public functions that are tensors without named axes."""
    unnamed = aliases(root)
    return [
        f"{function.place} {function.name}: {parameter}: {ast.unparse(annotation)}"
        for path in sorted(root.rglob("*.py"))
        for function in functions(path, root)
        if function.public and not function.is_class
        for parameter, annotation in function.parameters
        if is_bare(annotation, unnamed)
    ]


def wrong_names(root: Path) -> list[str]:
    """Return the names whose suffix does not agree with their axes, and models under another name than theirs."""
    return [
        f"{place} {what}"
        for path in sorted(root.rglob("*.py"))
        for place, what in (*_wrong_suffixes(path, root), *_wrong_models(path, root))
    ]


def _wrong_suffixes(path: Path, root: Path) -> Iterator[tuple[str, str]]:
    for function in functions(path, root):
        for parameter, annotation in function.parameters:
            name = parameter
            if parameter == "return":
                if not function.is_property:
                    continue
                name = function.name.rsplit(".", 1)[-1]
            kinds = {
                part for axes in arrays(annotation) if (part := " ".join(axes.split())) is not None
            }
            if (
                kinds
                and name not in PRESCRIBED
                and not any(suffix_agrees(name, axes) for axes in kinds)
            ):
                yield (
                    function.place,
                    f"{function.name}: {name} has the axes {' or '.join(map(repr, sorted(kinds)))}",
                )


def _wrong_models(path: Path, root: Path) -> Iterator[tuple[str, str]]:
    where = path.relative_to(root)
    for node in nodes(path.read_text()):
        if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None:
            text, patterns = ast.unparse(node.annotation).removesuffix(" | None"), _MODELS
            names = [node.arg] if isinstance(node, ast.arg) else [_last_name(node.target)]
        elif isinstance(node, ast.Assign):
            text, patterns = ast.unparse(node.value), _MAKERS
            names = [_last_name(target) for target in node.targets]
        else:
            continue
        for wanted, pattern in patterns.items():
            found = pattern.fullmatch(text) if patterns is _MODELS else pattern.search(text)
            for name in names:
                if (
                    found
                    and name is not None
                    and not re.fullmatch(rf"_?(\w+_)?{wanted}(_\w+)?", name)
                ):
                    yield f"{where}:{node.lineno}", f"{name} is a {wanted}"


def _last_name(node: ast.AST | None) -> str | None:
    return (
        node.id
        if isinstance(node, ast.Name)
        else node.attr
        if isinstance(node, ast.Attribute)
        else None
    )
