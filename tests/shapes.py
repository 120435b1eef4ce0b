"""Checks the jaxtyping axes of ksim_rl's functions at each call, while the tests run.

`install` puts a loader in front of ksim_rl's modules. It adds a decorator below all others to each function whose
annotations name axes, so that properties, cached functions, quantities and registered implementations are checked
whatever wraps them. Functions that Warp, Triton or TorchScript compile are left alone: these read a function's source.
`jaxtyping.jaxtyped` with beartype does the same for 33 us a call with two arguments; this takes 2 us, so that whole
training runs can be checked. Code that Dynamo traces calls through to the plain function.
"""

import ast
import dataclasses
import functools
import importlib.machinery
import inspect
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any

import jaxtyping
import torch
from jaxtyping import TypeCheckError

from tests.annotations import Check, check_of, items_check, names_a_shape

PACKAGE = "ksim_rl"
ROOT = Path(__file__).parents[1] / PACKAGE

# Decorators of functions whose source another compiler reads.
FOREIGN_COMPILERS = re.compile(
    r"(wp|warp)\.(kernel|func|func_native|func_grad|func_replay)|triton\.jit|torch\.jit\.script"
)

_DTYPES = {
    name
    for name, kind in vars(jaxtyping).items()
    if inspect.isclass(kind) and issubclass(kind, jaxtyping.AbstractDtype)
}
_ALIAS = re.compile(
    rf"^(\w+)(?:: TypeAlias)? = .*\b(?:{'|'.join(sorted(_DTYPES))})\[", re.MULTILINE
)


def shape_aliases(root: Path) -> set[str]:
    """Return the names that the package's modules give to annotations with axes."""
    return {name for path in root.rglob("*.py") for name in _ALIAS.findall(path.read_text())}


# ---- functions ----


def _unchecked(value: Any, sizes: dict[str, Any]) -> str:
    return ""


@dataclass
class Shaped:
    """A function of ksim_rl whose annotations name axes."""

    function: FunctionType
    parameters: tuple[str, ...]
    """Those with axes; `return` among them."""
    arguments: list[tuple[str, Check]] = field(default_factory=list)
    result: Check | None = None
    error: str = ""
    ready: bool = False

    @property
    def name(self) -> str:
        """Module and qualified name."""
        return f"{self.function.__module__}.{self.function.__qualname__}"

    def resolve(self) -> None:
        """Evaluate the annotations that name axes, once all names of the module are there."""
        self.ready = True
        names = inspect.getfullargspec(self.function)
        for parameter in self.parameters:
            annotation = self.function.__annotations__[parameter]
            try:
                if isinstance(annotation, str):
                    annotation = eval(annotation, self.function.__globals__)  # noqa: S307  # our own source
                assert names_a_shape(annotation), "without axes"
                check = check_of(annotation)
            except Exception as error:  # listed, and refused by a test
                self.error = f"{self.name}: {parameter}: {annotation}: {error!r}"
                check = _unchecked
            if parameter == names.varargs:
                check = items_check(tuple, iter, check)
            elif parameter == names.varkw:
                check = items_check(dict, dict.values, check)
            if parameter != "return":
                self.arguments.append((parameter, check))
            elif not inspect.isgeneratorfunction(self.function):
                self.result = check

    def check_arguments(self, *values: Any) -> dict[str, Any]:
        """Return the sizes that the arguments with axes bind; raises TypeCheckError where they disagree."""
        if not self.ready:
            self.resolve()
        sizes: dict[str, Any] = {}
        for (parameter, check), value in zip(self.arguments, values, strict=False):
            if error := check(value, sizes):
                self.fail(parameter, error, sizes)
        return sizes

    def check_result(self, value: Any, sizes: dict[str, Any]) -> Any:
        """Return `value`; raises TypeCheckError where it is not as annotated."""
        if self.result is not None and (error := self.result(value, sizes)):
            self.fail("return", error, sizes)
        return value

    def fail(self, parameter: str, error: str, sizes: Mapping[str, Any]) -> None:
        """Raise a TypeCheckError that names function, argument, annotation and the sizes bound so far."""
        what = "its result" if parameter == "return" else f"argument {parameter}"
        bound = ", ".join(f"{axis}={size}" for axis, size in sizes.items()) or "no axis bound yet"
        annotation = self.function.__annotations__[parameter]
        raise TypeCheckError(f"{self.name}: {what} {error}, annotated {annotation}, with {bound}")


_KINDS = inspect.Parameter
_FREE = ("is_compiling_", "function_", "check_arguments_", "check_result_")


@functools.cache
def _wrapper_code(
    code: CodeType, signature: inspect.Signature, name: str, checked: tuple[str, ...]
) -> CodeType:
    """Return code that takes the same arguments, so that binding them costs nothing, and stands at the same line."""
    heads, call, kind_before = [], [], None
    for parameter in signature.parameters.values():
        kind, p = parameter.kind, parameter.name
        if kind_before is _KINDS.POSITIONAL_ONLY and kind is not kind_before:
            heads.append("/")
        if kind is _KINDS.KEYWORD_ONLY and kind_before not in (kind, _KINDS.VAR_POSITIONAL):
            heads.append("*")
        star = {_KINDS.VAR_POSITIONAL: "*", _KINDS.VAR_KEYWORD: "**"}.get(kind, "")
        heads.append(star + p + ("" if parameter.default is _KINDS.empty else "=None"))
        call.append(f"{p}={p}" if kind is _KINDS.KEYWORD_ONLY else star + p)
        kind_before = kind
    if kind_before is _KINDS.POSITIONAL_ONLY:
        heads.append("/")
    values = ", ".join(p for p in checked if p != "return")
    tree = ast.parse(
        f"def enclosing({', '.join(_FREE)}):\n"
        f"    def wrapper({', '.join(heads)}):\n"
        "        if is_compiling_():\n"
        f"            return function_({', '.join(call)})\n"
        f"        sizes_ = check_arguments_({values})\n"
        f"        return check_result_(function_({', '.join(call)}), sizes_)\n"
    )
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt | ast.expr | ast.arg):
            node.lineno = node.end_lineno = code.co_firstlineno
    code_of_module = compile(tree, code.co_filename, "exec")
    (enclosing,) = [
        constant for constant in code_of_module.co_consts if isinstance(constant, CodeType)
    ]
    (wrapper,) = [constant for constant in enclosing.co_consts if isinstance(constant, CodeType)]
    return wrapper.replace(co_name=name, co_qualname=code.co_qualname)


WRAPPED: dict[str, Shaped] = {}
"""The functions that are checked, by module and qualified name."""


def checked(function: FunctionType, *parameters: str) -> FunctionType:
    """Return `function` with those arguments checked whose `parameters` name axes, and its result for `return`."""
    shaped = Shaped(function, parameters)
    signature = inspect.signature(function)
    bare = signature.replace(
        parameters=[
            p.replace(
                annotation=_KINDS.empty, default=p.default if p.default is _KINDS.empty else None
            )
            for p in signature.parameters.values()
        ],
        return_annotation=inspect.Signature.empty,
    )
    code = _wrapper_code(function.__code__, bare, function.__name__, parameters)
    free = dict(
        zip(
            _FREE,
            (
                torch.compiler.is_compiling,
                function,
                # Functions, since Dynamo cannot wrap the bound methods in the closure of an `__init__`.
                lambda *values: shaped.check_arguments(*values),
                lambda value, sizes: shaped.check_result(value, sizes),
            ),
            strict=True,
        )
    )
    closure = tuple(CellType(free[name]) for name in code.co_freevars)
    # With the function's own globals and file, as Dynamo expects of what it traces.
    wrapper = FunctionType(code, function.__globals__, function.__name__, closure=closure)
    wrapper.__defaults__, wrapper.__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    # An overload, a property's setter or a variant in another branch has the name of the one before.
    WRAPPED[f"{shaped.name}:{function.__code__.co_firstlineno}"] = shaped
    return functools.update_wrapper(wrapper, function)


def checked_class(*fields: str) -> Callable[[type], type]:
    """Return a decorator that checks those `fields` of a dataclass in the `__init__` that `dataclass` wrote."""

    def decorate(cls: type) -> type:
        init = vars(cls).get("__init__")
        parameters = tuple(name for name in fields if name in getattr(init, "__annotations__", {}))
        if dataclasses.is_dataclass(cls) and isinstance(init, FunctionType) and parameters:
            cls.__init__ = checked(init, *parameters)
        return cls

    return decorate


# ---- modules ----

FOREIGN: list[str] = []
"""The functions that another compiler reads, so that they are left alone."""
PLAIN: list[str] = []
"""The functions whose annotations name no axes."""


def _dotted(decorator: ast.expr) -> str:
    if isinstance(decorator, ast.Call):
        return _dotted(decorator.func)
    if isinstance(decorator, ast.Attribute):
        return f"{_dotted(decorator.value)}.{decorator.attr}"
    return decorator.id if isinstance(decorator, ast.Name) else ""


def is_foreign(decorator: ast.expr) -> bool:
    """Say whether a decorator hands the function's source to another compiler."""
    return FOREIGN_COMPILERS.fullmatch(_dotted(decorator)) is not None


class _Decorating(ast.NodeTransformer):
    """Adds `checked` below all other decorators of a module's functions, where an annotation names axes."""

    def __init__(self, module: str, names: set[str]):
        self.scope = [module]
        self.names = names

    def _mentions(self, annotation: ast.expr | None) -> bool:
        return annotation is not None and any(
            isinstance(node, ast.Name) and node.id in self.names for node in ast.walk(annotation)
        )

    def _decorator(
        self, name: str, node: ast.FunctionDef | ast.ClassDef, parameters: list[str]
    ) -> ast.expr:
        module = ast.Call(
            ast.Name("__import__", ast.Load()), [ast.Constant(__name__), *_NO_NAMES], []
        )
        named = ast.Call(
            ast.Attribute(module, name, ast.Load()), [ast.Constant(p) for p in parameters], []
        )
        ast.copy_location(named, (node.decorator_list or [node])[0])
        return ast.fix_missing_locations(named)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.ClassDef:
        self._inside(node)
        fields = [
            part.target.id
            for part in node.body
            if isinstance(part, ast.AnnAssign)
            and isinstance(part.target, ast.Name)
            and self._mentions(part.annotation)
        ]
        if fields and any("dataclass" in _dotted(decorator) for decorator in node.decorator_list):
            node.decorator_list.insert(0, self._decorator("checked_class", node, fields))
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        self._inside(node)
        name = ".".join([*self.scope, node.name])
        if any(map(is_foreign, node.decorator_list)):
            FOREIGN.append(name)
            return node
        arguments = node.args
        parts = [
            *arguments.posonlyargs,
            *arguments.args,
            *arguments.kwonlyargs,
            arguments.vararg,
            arguments.kwarg,
        ]
        parameters = [
            part.arg for part in parts if part is not None and self._mentions(part.annotation)
        ]
        if self._mentions(node.returns):
            parameters.append("return")
        if parameters:
            node.decorator_list.append(self._decorator("checked_function", node, parameters))
        else:
            PLAIN.append(name)
        return node

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Visit the statements inside of one: nine tenths of a tree are expressions, which define no function."""
        for part in ("body", "orelse", "handlers", "finalbody", "cases"):
            for inner in getattr(node, part, ()):
                self.visit(inner)
        return node

    def _inside(self, node: ast.FunctionDef | ast.ClassDef) -> None:
        self.scope.append(node.name)
        self.generic_visit(node)
        self.scope.pop()


_NO_NAMES = [ast.Constant(None), ast.Constant(None), ast.Constant(("checked",))]


def checked_function(*parameters: str) -> Callable[[FunctionType], FunctionType]:
    """Return `checked` as a decorator."""
    return lambda function: checked(function, *parameters)


class ShapeCheckingLoader(importlib.machinery.SourceFileLoader):
    aliases: set[str] = set()

    def get_code(self, fullname: str) -> CodeType:
        # Without the cache of bytecode, which runs outside of tests read too.
        path = self.get_filename(fullname)
        source = self.get_data(path)
        tree = ast.parse(source, path)
        imported: set[str] = set()
        # Walking through a tree takes longer than parsing it.
        if b"jaxtyping" in source:
            for node in ast.walk(tree):
                if isinstance(node, ast.ImportFrom) and node.module == "jaxtyping":
                    imported.update(alias.asname or alias.name for alias in node.names)
        tree = _Decorating(fullname, imported | self.aliases).visit(tree)
        return compile(tree, path, "exec", dont_inherit=True)

    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        for shaped in WRAPPED.values():
            if not shaped.ready and shaped.function.__module__ == module.__name__:
                shaped.resolve()


class _ShapeCheckingFinder:
    def find_spec(self, fullname, path=None, target=None):
        if fullname.split(".")[0] != PACKAGE:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and type(spec.loader) is importlib.machinery.SourceFileLoader:
            spec.loader = ShapeCheckingLoader(spec.loader.name, spec.loader.path)
        return spec


def install() -> None:
    """Check the functions of ksim_rl's modules that are imported from now on."""
    assert PACKAGE not in sys.modules, "imported before the shape checks"
    ShapeCheckingLoader.aliases = shape_aliases(ROOT)
    sys.meta_path.insert(0, _ShapeCheckingFinder())
