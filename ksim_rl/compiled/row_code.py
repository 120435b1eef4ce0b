"""Writes torch operations as C++ for one row of a batch; `tape` makes kernels of it.

Each function writes loops that read and write elements through `Cells`, which knows where a tensor lies: in the
memory of the device, or in an array of the row's own. The operations follow torch, with its rules for types and for
numbers that are not finite.
"""

import math
from collections.abc import Callable

from torch import Tensor
from torch.utils._pytree import PyTree

from ksim_rl.compiled.cells import CTYPES, Cells, NotARowError, literal, names_of
from ksim_rl.compiled.row_formulas import POINTWISE, TESTS, write_pointwise, write_power
from ksim_rl.compiled.row_indices import (
    write_gather,
    write_index,
    write_index_put,
    write_index_select,
)
from ksim_rl.device.recording import OpArgs, Operation, OpKwargs, OpOverload

_FILLS = {
    "empty": 0,
    "empty_like": 0,
    "new_empty": 0,
    "new_zeros": 0,
    "ones": 1,
    "ones_like": 1,
    "zeros": 0,
}
_FILLS |= {"zeros_like": 0, "new_ones": 1}
# The start of a sum `s`, its update by an element `e`, and the result of `count` elements.
_REDUCTIONS = {
    "all": ("1", "s = s && e != 0", "s"),
    "amax": ("-INFINITY", "s = high(s, e)", "s"),
    "amin": ("INFINITY", "s = low(s, e)", "s"),
    "any": ("0", "s = s || e != 0", "s"),
    "linalg_vector_norm": ("0", "s += e * e", "sqrt(s)"),
    "mean": ("0", "s += e", "s / count"),
    "prod": ("1", "s *= e", "s"),
    "sum": ("0", "s += e", "s"),
}


def write(operation: Operation, cells: Cells) -> None:
    """Write an operation as loops of the cells; a NotARowError where there is no C++ of it."""
    args = operation.args
    kwargs = operation.kwargs
    outs = [*operation.made, *operation.written]
    name = operation.name
    if name.endswith("_") and not name.startswith("_"):  # `add_` writes what `add` returns
        name = name.removesuffix("_")
    if name in _SPECIAL:
        return _SPECIAL[name](args, kwargs, outs[0], cells)
    if len(outs) > 1:  # no function below writes two tensors
        raise NotARowError("several results")
    if name in _FILLS:
        return _fill(outs[0], _FILLS[name], cells)
    if name in ("full", "full_like", "new_full", "scalar_tensor"):
        return _fill(outs[0], args[0 if name == "scalar_tensor" else -1], cells)
    if name in _REDUCTIONS:
        return _reduce(operation.function, name, args, kwargs, outs[0], cells)
    if name in ("cat", "stack"):
        return _join(name, args, kwargs, outs[0], cells)
    expression = POINTWISE.get(name) or TESTS.get(name)
    if expression is None:
        raise NotARowError(str(operation.function))
    return write_pointwise(name, expression, args, kwargs, outs[0], cells)


def _fill(out: Tensor, value: PyTree, cells: Cells) -> None:
    if isinstance(value, Tensor):
        raise NotARowError("fill by a tensor")
    shape = cells.inner(out)
    number = literal(value, CTYPES[out.dtype])
    cells.loop(shape, [f"{cells.at(out, names_of(len(shape)))} = {number};"])


def _dims(
    function: OpOverload, args: OpArgs, kwargs: OpKwargs, ndim: int
) -> tuple[list[int], bool]:
    given = dict(zip([a.name for a in function._schema.arguments], args, strict=False)) | kwargs
    if (
        given.get("dtype") is not None
        and given["dtype"] != args[0].dtype
        and args[0].is_floating_point()
    ):
        raise NotARowError("a sum of another type")
    dims = given.get("dim")
    if given.get("ord", 2) != 2:
        raise NotARowError("another norm")
    if dims is None or dims == []:
        dims = range(ndim)
    elif isinstance(dims, int):
        dims = [dims]
    return sorted(dim % ndim for dim in dims), bool(given.get("keepdim", False))


def _reduce(
    function: OpOverload, name: str, args: OpArgs, kwargs: OpKwargs, out: Tensor, cells: Cells
) -> None:
    source = args[0]
    if source.ndim == 0:
        raise NotARowError("a reduction of a number")
    dims, keeps = _dims(function, args, kwargs, source.ndim)
    if cells.rows and 0 in dims or name in ("amax", "amin") and not out.is_floating_point():
        raise NotARowError("a reduction over rows, or of whole numbers")
    start, step, end = _REDUCTIONS[name]
    first = bool(cells.rows)
    kept = [k for k in range(first, source.ndim) if k not in dims]
    names = dict(zip(kept, names_of(len(kept)), strict=True))
    # Where the result is: dims that are reduced have length 1 there, or are gone.
    place = []  # indices of the result
    for k in range(first, source.ndim):
        if k in kept:
            place.append(names[k])
        elif keeps:
            place.append("0")
    names |= {k: f"k{k}" for k in dims}
    names = dict(sorted(names.items()))
    if name in ("any", "all"):
        ctype = "bool"
    else:
        ctype = CTYPES[out.dtype]
    count = math.prod(source.shape[k] for k in dims)  # elements of each sum
    inner = f"const {ctype} e = ({ctype}){cells.at(source, list(names.values()))}; {step};"
    over = " ".join(
        f"for (int {names[k]} = 0; {names[k]} < {source.shape[k]}; ++{names[k]})" for k in dims
    )
    end = end.replace("count", literal(count, ctype))
    body = f"{ctype} s = {start}; {over} {{ {inner} }} {cells.at(out, place)} = {end};"
    cells.loop([source.shape[k] for k in kept], [body])


def _join(name: str, args: OpArgs, kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    tensors = [t for t in args[0] if t.numel() or t.ndim > 1]
    dim = (args[1] if len(args) > 1 else kwargs.get("dim", 0)) % out.ndim
    first = int(bool(cells.rows))
    if dim < first:
        raise NotARowError("rows are joined")
    offset = 0  # of the present tensor in the result, along `dim`
    for number, tensor in enumerate(tensors):
        shape = list(tensor.shape[first:])
        names = names_of(len(shape))
        place = list(names)
        if name == "stack":
            place.insert(dim - first, str(number))
        else:
            place[dim - first] = f"({place[dim - first]} + {offset})"
            offset += tensor.shape[dim]
        cells.loop(
            shape, [f"{cells.at(out, place)} = ({CTYPES[out.dtype]}){cells.at(tensor, names)};"]
        )


def _cross(args: OpArgs, kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    dim = kwargs.get("dim", -1)
    if len(args) > 2:
        dim = args[2]
    # Counted from the first dim; where a kernel has rows, they are a dim that its C++ does not see.
    dim = dim % out.ndim
    if cells.rows:
        dim -= 1
    if dim < 0:
        raise NotARowError("a cross product of rows")
    shape = cells.inner(out)
    names = names_of(len(shape))

    def at(tensor: Tensor, k: int) -> str:
        return cells.at(tensor, [*names[:dim], str(k), *names[dim + 1 :]])

    ctype = CTYPES[out.dtype]
    body = [
        f"const {ctype} {letter}{k} = {at(args[n], k)};"
        for n, letter in enumerate("xy")
        for k in range(3)
    ]
    pairs = ((1, 2), (2, 0), (0, 1))
    body += [f"{at(out, k)} = x{i} * y{j} - x{j} * y{i};" for k, (i, j) in enumerate(pairs)]
    shape[dim] = 1  # one place writes all three components
    cells.loop(shape, body)


def _bmm(args: tuple[Tensor, Tensor], kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    if not cells.rows:
        raise NotARowError("matrices without rows")
    left, right = args
    term = f"s += {cells.at(left, ['i0', 'k'])} * {cells.at(right, ['k', 'i1'])};"
    body = f"{CTYPES[out.dtype]} s = 0; for (int k = 0; k < {left.shape[2]}; ++k) {term}"
    cells.loop(out.shape[1:], [body, f"{cells.at(out, ['i0', 'i1'])} = s;"])


def _draw(
    args: tuple[Tensor, int, Tensor, int, int, int, int, float, float, int, int],
    kwargs: OpKwargs,
    out: Tensor,
    cells: Cells,
) -> None:
    seed, stream, counter, _, first_row, n, kind, low, high, start, span = args
    plain = cells.uniform
    if counter.ndim:
        count = cells.at(counter, [])  # each row has its own counter
    else:
        count = plain.at(counter, [])
    low_ = literal(low, "float")
    width = f"({literal(high, 'float')} - {literal(low, 'float')})"
    value = (
        f"{low_} + unit(b) * {width}",
        "normal(b)",
        f"{start}LL + (long long)((b * {span}ull) >> 32)",
    )[kind]
    key = f"const RowKey key = key_of({plain.at(seed, [])}, {stream}u, {count}, {first_row} + row);"
    body = f"const unsigned b = bits_of(key, (unsigned)i0); {cells.at(out, ['i0'])} = {value};"
    cells.loop([n], [key, body])


def _count_non_finite(
    args: tuple[Tensor, Tensor, Tensor, Tensor, Tensor], kwargs: OpKwargs, out: Tensor, cells: Cells
) -> None:
    table, term, step, first, count = args
    plain = cells.uniform
    at = f"{plain.at(term, ['i0'])}"
    body = [
        f"if (!(fabsf({cells.at(table, ['i0'])}) <= 3.402823466e38f)) {{ const int term = {at};"
    ]
    body += [f"const long long place = {plain.at(step, [])} * {table.shape[0]} + row;"]
    body += [
        f"count_up(&{plain.at(count, ['term'])}); keep_least(&{plain.at(first, ['term'])}, place); }}"
    ]
    cells.loop(table.shape[1:], body)


_SPECIAL: dict[str, Callable[..., None]] = {
    "bmm": _bmm,
    "count_non_finite": _count_non_finite,
    "draw": _draw,
    "gather": write_gather,
    "index": write_index,
    "index_put": write_index_put,
    "index_select": write_index_select,
    "linalg_cross": _cross,
    "pow": write_power,
}
