"""Writes torch operations as C++ for one row of a batch; `tape` makes kernels of it.

Each function writes loops that read and write elements through `Cells`, which knows where a tensor lies: in the
memory of the device, or in an array of the row's own. The operations follow torch, with its rules for types and for
numbers that are not finite.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.utils._pytree import PyTree

from ksim_rl.compiled.cells import CTYPES, Cells, NotARowError, literal, names_of
from ksim_rl.device.recording import OpArgs, Operation, OpKwargs, OpOverload

# Operands are a, b, c in the order of the schema, in the type that torch computes in.
_POINTWISE = {
    "abs": "a > 0 ? a : 0 - a",
    "add": "a + b * alpha",
    "addcdiv": "a + value * b / c",
    "addcmul": "a + value * b * c",
    "acos": "acos(a)",
    "asin": "asin(a)",
    "atan": "atan(a)",
    "atan2": "atan2(a, b)",
    "clamp": "low(high(a, b), c)",
    "clamp_max": "low(a, b)",
    "clamp_min": "high(a, b)",
    "clone": "a",
    "copy": "b",
    "cos": "cos(a)",
    "div": "a / b",
    "exp": "exp(a)",
    "expm1": "exp_less_1(a)",
    "fill": "b",
    "floor": "floor(a)",
    "nan_to_num": "a != a ? nan : a > most ? above : a < -most ? below : a",
    "lerp": "c < 0.5f ? a + c * (b - a) : b - (b - a) * (1 - c)",
    "log": "log(a)",
    "log1p": "log_1_plus(a)",
    "masked_fill": "m ? b : a",
    "maximum": "high(a, b)",
    "minimum": "low(a, b)",
    "mul": "a * b",
    "neg": "-a",
    "reciprocal": "1 / a",
    "relu": "high(a, 0)",
    "remainder": "modulo(a, b)",
    "round": "rint(a)",
    "rsqrt": "1 / sqrt(a)",
    "rsub": "b - a * alpha",
    "sigmoid": "1 / (1 + exp(-a))",
    "sign": "(a > 0) - (a < 0)",
    "sin": "sin(a)",
    "sqrt": "sqrt(a)",
    "square": "a * a",
    "sub": "a - b * alpha",
    "tan": "tan(a)",
    "tanh": "tanh(a)",
    "where": "m ? a : b",
    "zero": "0",
    "_to_copy": "a",
    "_unsafe_view": "a",
    "bitwise_and": "a & b",
    "bitwise_not": "~a",
    "bitwise_or": "a | b",
    "bitwise_xor": "a ^ b",
}
# The result is a bool, computed in the operands' own type.
_TESTS = {
    "eq": "a == b",
    "ge": "a >= b",
    "gt": "a > b",
    "isfinite": "a - a == 0",
    "isinf": "a == a && a - a != 0",
    "isnan": "a != a",
    "le": "a <= b",
    "logical_and": "(a != 0) & (b != 0)",
    "logical_not": "a == 0",
    "logical_or": "(a != 0) | (b != 0)",
    "logical_xor": "(a != 0) != (b != 0)",
    "lt": "a < b",
    "ne": "a != b",
}
_FILLS = {"empty": 0, "empty_like": 0, "new_empty": 0, "new_zeros": 0, "ones": 1, "ones_like": 1, "zeros": 0}
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
PRELUDE = r"""
    auto high = [](auto x, auto y) { return x > y || x != x ? x : (decltype(x))y; };
    auto low = [](auto x, auto y) { return x < y || x != x ? x : (decltype(x))y; };
    auto count_up = [](long long* count) {
    #if defined(__CUDA_ARCH__)
        atomicAdd((unsigned long long*)count, 1ull);
    #else
        *count += 1;
    #endif
    };
    auto least = [](long long* kept, long long value) {
    #if defined(__CUDA_ARCH__)
        atomicMin((unsigned long long*)kept, (unsigned long long)value);
    #else
        *kept = value < *kept ? value : *kept;
    #endif
    };
    // Exact to rounding, by W. Kahan; not every compiler's library has them.
    auto log_1_plus = [](auto x) {
        const auto u = 1 + x;
        return u == 1 ? x : u - 1 == u ? log(u) : log(u) * x / (u - 1);
    };
    auto exp_less_1 = [](auto x) {
        const auto u = exp(x);
        return u == 1 ? x : u - 1 == u ? u : u - 1 == -1 ? (decltype(x))-1 : (decltype(x))((u - 1) * x / log(u));
    };
    auto modulo = [](auto x, auto y) {
        auto rest = (decltype(x))(x - (decltype(x))(long long)(x / y) * y);
        if constexpr ((decltype(x))0.5 != 0) rest = (decltype(x))fmod(x, y);
        return rest != 0 && (rest < 0) != (y < 0) ? (decltype(x))(rest + y) : rest;
    };
"""


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
    expression = _POINTWISE.get(name) or _TESTS.get(name)
    if expression is None:
        raise NotARowError(str(operation.function))
    return _pointwise(name, expression, args, kwargs, outs[0], cells)


def _inner(tensor: Tensor, cells: Cells) -> list[int]:
    """Return the shape of a result without its rows."""
    if cells.rows:
        return list(tensor.shape[1:])
    return list(tensor.shape)


def _fill(out: Tensor, value: PyTree, cells: Cells) -> None:
    if isinstance(value, Tensor):
        raise NotARowError("fill by a tensor")
    shape = _inner(out, cells)
    number = literal(value, CTYPES[out.dtype])
    cells.loop(shape, [f"{cells.at(out, names_of(len(shape)))} = {number};"])


def _pointwise(name: str, expression: str, args: OpArgs, kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    if kwargs.get("rounding_mode") is not None:
        raise NotARowError("division that rounds")
    operands = list(args)
    if name in ("_to_copy", "clone", "nan_to_num", "_unsafe_view", "round"):
        operands = operands[:1]  # the rest are options
    if name in ("where", "masked_fill"):
        masks = [operands.pop({"where": 0, "masked_fill": 1}[name])]
    else:
        masks = []
    if name == "clamp":
        operands += [kwargs.get("min"), kwargs.get("max")][len(operands) - 1 :]
        expression = {(True, True): "a", (False, True): "high(a, b)", (True, False): "low(a, c)"}.get(
            (operands[1] is None, operands[2] is None), expression
        )
    shape = _inner(out, cells)
    place = names_of(len(shape))
    tensors = [x for x in operands if isinstance(x, Tensor)]
    computed = out.dtype  # torch computes in the type of the result
    if name in _TESTS:
        computed = tensors[0].dtype  # tests give bools, and compare in the operands' type
        for operand in operands[1:]:
            if isinstance(operand, Tensor):
                computed = torch.result_type(tensors[0], operand)
            elif type(operand) is float and not computed.is_floating_point:
                computed = torch.get_default_dtype()
    ctype = CTYPES[computed]
    if name == "bitwise_not" and computed == torch.bool:
        expression = "!a"
    body = []
    for letter, operand in zip("abc", operands, strict=False):
        if operand is None:  # a clamp without this bound
            continue
        if isinstance(operand, Tensor):
            value = cells.at(operand, place)
        else:
            value = literal(operand, ctype)
        if not isinstance(operand, (Tensor, int, float, bool)):
            raise NotARowError(f"an operand {operand!r}")
        body.append(f"const {ctype} {letter} = ({ctype}){value};")
    if masks:
        body.append(f"const bool m = {cells.at(masks[0], place)};")
    if name == "nan_to_num":
        given = dict(zip(("nan", "posinf", "neginf"), args[1:], strict=False)) | kwargs
        most = torch.finfo(computed).max
        numbers = {"nan": given.get("nan"), "above": given.get("posinf"), "below": given.get("neginf")}
        usual = {"nan": 0.0, "above": most, "below": -most}
        chosen = {key: usual[key] if value is None else value for key, value in numbers.items()} | {
            "most": most
        }
        body += [f"const {ctype} {key} = {literal(value, ctype)};" for key, value in chosen.items()]
    for option in ("alpha", "value"):
        if option in expression:
            body.append(f"const {ctype} {option} = {literal(kwargs.get(option, 1), ctype)};")
    body.append(f"{cells.at(out, place)} = ({CTYPES[out.dtype]})({expression});")
    cells.loop(shape, body)


def _pow(args: OpArgs, kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    base, exponent = args[:2]
    if isinstance(base, Tensor) and isinstance(exponent, (int, float)):
        expression = {2: "a * a", 1: "a", 0.5: "sqrt(a)", 3: "a * a * a", -1: "1 / a"}.get(
            exponent, "pow(a, b)"
        )
    else:
        expression = "pow(a, b)"
    return _pointwise("", expression, args, kwargs, out, cells)


def _dims(function: OpOverload, args: OpArgs, kwargs: OpKwargs, ndim: int) -> tuple[list[int], bool]:
    given = dict(zip([a.name for a in function._schema.arguments], args, strict=False)) | kwargs
    if given.get("dtype") is not None and given["dtype"] != args[0].dtype and args[0].is_floating_point():
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
    over = " ".join(f"for (int {names[k]} = 0; {names[k]} < {source.shape[k]}; ++{names[k]})" for k in dims)
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
        cells.loop(shape, [f"{cells.at(out, place)} = ({CTYPES[out.dtype]}){cells.at(tensor, names)};"])


def _one_index(indices: Sequence[PyTree]) -> int:
    """Return the dim that is indexed; only one may be, by numbers."""
    places = [k for k, index in enumerate(indices) if index is not None]
    if len(places) != 1 or indices[places[0]].dtype != torch.int64:
        raise NotARowError("several indices, or a mask")
    return places[0]


def _picked(index: Tensor, names: Sequence[str], size: int, cells: Cells) -> str:
    cell = cells.at(index, names)
    return f"({cell} < 0 ? {cell} + {size} : {cell})"


def _index(args: OpArgs, kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    source, indices = args[:2]
    dim = _one_index(indices)
    index = indices[dim]
    first = int(bool(cells.rows))
    shape = _inner(out, cells)
    names = names_of(len(shape))
    at = dim - first
    if dim < first:  # each row picks from a table that all have
        picked = _picked(index, names[: index.ndim - 1], source.shape[0], cells)
        place = [picked, *names[index.ndim - 1 :]]
        cells.loop(shape, [f"{cells.at(out, names)} = {cells.uniform.at(source, place)};"])
        return
    picked = _picked(index, names[at : at + index.ndim], source.shape[dim], cells.uniform)
    place = [*names[:at], picked, *names[at + index.ndim :]]
    cells.loop(shape, [f"{cells.at(out, names)} = {cells.at(source, place)};"])


def _index_select(args: tuple[Tensor, int, Tensor], kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    source, dim, index = args
    _index((source, [*[None] * (dim % source.ndim), index]), kwargs, out, cells)


def _index_put(args: OpArgs, kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    target, indices, values = args[:3]
    if len(args) > 3 and args[3]:
        raise NotARowError("index_put that adds")
    dim = _one_index(indices)
    index = indices[dim]
    first = int(bool(cells.rows))
    if dim < first or target is not out:
        raise NotARowError("rows are written")
    at = dim - first
    shape = [*out.shape[first:dim], *index.shape, *out.shape[dim + 1 :]]
    names = names_of(len(shape))
    picked = _picked(index, names[at : at + index.ndim], out.shape[dim], cells.uniform)
    place = [*names[:at], picked, *names[at + index.ndim :]]
    cells.loop(shape, [f"{cells.at(out, place)} = {cells.at(values, names)};"])


def _gather(args: tuple[Tensor, int, Tensor], kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    source, dim, index = args[:3]
    dim = dim % source.ndim
    first = int(bool(cells.rows))
    if dim < first:
        raise NotARowError("rows are gathered")
    names = names_of(out.ndim - first)
    place = [*names]
    place[dim - first] = f"(int){cells.at(index, names)}"  # gather takes no negative numbers
    cells.loop(_inner(out, cells), [f"{cells.at(out, names)} = {cells.at(source, place)};"])


def _cross(args: OpArgs, kwargs: OpKwargs, out: Tensor, cells: Cells) -> None:
    dim = kwargs.get("dim", args[2] if len(args) > 2 else -1) % out.ndim - int(bool(cells.rows))
    if dim < 0:
        raise NotARowError("a cross product of rows")
    shape = _inner(out, cells)
    names = names_of(len(shape))

    def at(tensor: Tensor, k: int) -> str:
        return cells.at(tensor, [*names[:dim], str(k), *names[dim + 1 :]])

    ctype = CTYPES[out.dtype]
    body = [
        f"const {ctype} {letter}{k} = {at(args[n], k)};" for n, letter in enumerate("xy") for k in range(3)
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
    value = (f"{low_} + unit(b) * {width}", "normal(b)", f"{start}LL + (long long)((b * {span}ull) >> 32)")[
        kind
    ]
    key = f"const RowKey key = key_of({plain.at(seed, [])}, {stream}u, {count}, {first_row} + row);"
    body = f"const unsigned b = bits_of(key, (unsigned)i0); {cells.at(out, ['i0'])} = {value};"
    cells.loop([n], [key, body])


def _count_non_finite(
    args: tuple[Tensor, Tensor, Tensor, Tensor, Tensor], kwargs: OpKwargs, out: Tensor, cells: Cells
) -> None:
    table, term, step, first, count = args
    plain = cells.uniform
    at = f"{plain.at(term, ['i0'])}"
    body = [f"if (!(fabsf({cells.at(table, ['i0'])}) <= 3.402823466e38f)) {{ const int term = {at};"]
    body += [f"const long long place = {plain.at(step, [])} * {table.shape[0]} + row;"]
    body += [f"count_up(&{plain.at(count, ['term'])}); least(&{plain.at(first, ['term'])}, place); }}"]
    cells.loop(table.shape[1:], body)


_SPECIAL: dict[str, Callable[..., None]] = {
    "bmm": _bmm,
    "count_non_finite": _count_non_finite,
    "draw": _draw,
    "gather": _gather,
    "index": _index,
    "index_put": _index_put,
    "index_select": _index_select,
    "linalg_cross": _cross,
    "pow": _pow,
}
