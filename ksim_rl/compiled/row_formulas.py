"""Writes operations that act element by element as C++, each by its formula."""

import torch
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.compiled.cells import CTYPES, Cells, NotARowError, literal, names_of
from ksim_rl.device.recording import OpArgs, OpKwargs

# Operands are a, b, c in the order of the schema, in the type that torch computes in.
POINTWISE = {
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
# A clamp, by whether it has a lower bound b and an upper bound c.
_CLAMPS = {
    (True, True): POINTWISE["clamp"],
    (True, False): "high(a, b)",
    (False, True): "low(a, c)",
    (False, False): "a",
}
# Powers that need no `pow`.
_POWERS = {2: "a * a", 1: "a", 0.5: "sqrt(a)", 3: "a * a * a", -1: "1 / a"}
# The result is a bool, computed in the operands' own type.
TESTS = {
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


def write_pointwise(
    name: str,
    expression: str,
    args: OpArgs,
    kwargs: OpKwargs,
    out: Shaped[Tensor, "*out"],
    cells: Cells,
) -> None:
    """Write an operation that computes each element of `out` from the operands' elements at the same place."""
    if kwargs.get("rounding_mode") is not None:
        raise NotARowError("division that rounds")
    operands = list(args)
    if name in ("_to_copy", "clone", "nan_to_num", "_unsafe_view", "round"):
        operands = operands[:1]  # the rest are options
    mask = None
    if name == "where":
        mask = operands.pop(0)
    elif name == "masked_fill":
        mask = operands.pop(1)
    if name == "clamp":
        operands += [kwargs.get("min"), kwargs.get("max")][len(operands) - 1 :]
        expression = _CLAMPS[operands[1] is not None, operands[2] is not None]
    shape = cells.inner(out)
    place = names_of(len(shape))
    tensors = [x for x in operands if isinstance(x, Tensor)]
    computed = out.dtype  # torch computes in the type of the result
    if name in TESTS:
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
    if mask is not None:
        body.append(f"const bool m = {cells.at(mask, place)};")
    if name == "nan_to_num":
        for key, value in _replacements(args, kwargs, computed).items():
            body.append(f"const {ctype} {key} = {literal(value, ctype)};")
    for option in ("alpha", "value"):
        if option in expression:
            body.append(f"const {ctype} {option} = {literal(kwargs.get(option, 1), ctype)};")
    body.append(f"{cells.at(out, place)} = ({CTYPES[out.dtype]})({expression});")
    cells.loop(shape, body)


def _replacements(args: OpArgs, kwargs: OpKwargs, dtype: torch.dtype) -> dict[str, float]:
    """Return the numbers that `nan_to_num` puts in place of others, by their names in its formula."""
    given = dict(zip(("nan", "posinf", "neginf"), args[1:], strict=False)) | kwargs
    most = torch.finfo(dtype).max
    chosen = {"nan": 0.0, "above": most, "below": -most, "most": most}
    for key, option in (("nan", "nan"), ("above", "posinf"), ("below", "neginf")):
        if given.get(option) is not None:
            chosen[key] = given[option]
    return chosen


def write_power(args: OpArgs, kwargs: OpKwargs, out: Shaped[Tensor, "*out"], cells: Cells) -> None:
    """Write a power of elements."""
    base, exponent = args[:2]
    if isinstance(base, Tensor) and isinstance(exponent, (int, float)):
        expression = _POWERS.get(exponent, "pow(a, b)")
    else:
        expression = "pow(a, b)"
    return write_pointwise("", expression, args, kwargs, out, cells)
