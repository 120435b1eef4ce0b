"""A recorded function gives what it gave, in few kernels: operation by operation, and where rows could meet."""

import gc
import math
import weakref

import pytest
import torch

from ksim_rl.compiled import cells
from ksim_rl.compiled.tape import Kernel, Tape
from ksim_rl.device import random, recording
from ksim_rl.device.quick_launch import ADDRESS, QuickLaunch, arguments_of

E = 7
ODD = torch.tensor([math.nan, math.inf, -math.inf, -0.0, 0.0, 0.5, -1.5])


def taped(function, *inputs):
    """Record a function, replay it on other numbers in the same memory, and return what both make of these."""
    first = [x.clone() for x in inputs]
    with recording.recorded() as recorder:
        results = function(*first)
    results = results if isinstance(results, tuple) else (results,)
    tape = Tape(recorder, num_rows=E, returned=results)
    others = [x.flip(0) if x.ndim and x.shape[0] == E else x for x in inputs]
    for held, other in zip(first, others, strict=True):
        held.copy_(other)
    tape()
    expected = function(*[x.clone() for x in others])
    return tape, results, expected if isinstance(expected, tuple) else (expected,)


def check(function, *inputs, kernels=None, exact=False):
    tape, found, expected = taped(function, *inputs)
    for own, true in zip(found, expected, strict=True):
        assert own.dtype == true.dtype and own.shape == true.shape
        tolerance = {"rtol": 0.0, "atol": 0.0} if exact else {"rtol": 2e-6, "atol": 1e-6}
        torch.testing.assert_close(own, true, equal_nan=True, **tolerance)
    if kernels is not None:
        assert kernels_of(tape) == [Kernel] * kernels
    return tape


def kernels_of(tape):
    return [type(part) if isinstance(part, Kernel) else part for part in tape.parts]


def floats(*shape):
    return torch.randn(E, *shape, generator=torch.Generator().manual_seed(len(shape) + 1))


def whole(*shape):
    return torch.randint(-5, 6, (E, *shape), generator=torch.Generator().manual_seed(3))


UNARY = (
    "abs",
    "atan",
    "cos",
    "exp",
    "expm1",
    "floor",
    "neg",
    "round",
    "sigmoid",
    "sign",
    "sin",
    "square",
    "tan",
)
UNARY += (
    "tanh",
    "isnan",
    "isfinite",
    "isinf",
    "logical_not",
    "nan_to_num",
    "relu",
    "clone",
    "reciprocal",
)


@pytest.mark.parametrize("name", UNARY)
@pytest.mark.parametrize("numbers", ["usual", "odd"])
def test_functions_of_one_number(name, numbers):
    value = floats(3) if numbers == "usual" else ODD[:, None].expand(E, 3).contiguous()
    check(getattr(torch, name), value, kernels=1)


@pytest.mark.parametrize("name", ["sqrt", "rsqrt", "log", "log1p", "acos", "asin"])
def test_functions_of_a_part_of_the_numbers(name):
    check(getattr(torch, name), floats(3).abs().clamp(max=0.9) + 0.05, kernels=1)


PAIRS = (
    "add",
    "sub",
    "mul",
    "div",
    "maximum",
    "minimum",
    "remainder",
    "atan2",
    "eq",
    "ne",
    "lt",
    "le",
    "gt",
    "ge",
)
PAIRS += ("logical_and", "logical_or", "logical_xor", "pow")


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("other", ["rows", "column", "one for all", "number"])
def test_functions_of_two_numbers(name, other):
    second = {
        "rows": floats(3) + 0.1,
        "column": floats(1) + 0.1,
        "one for all": torch.tensor([0.3, -2.0, 1.5]),
    }
    value = floats(3).abs() + 0.1 if name == "pow" else floats(3)
    if other == "number":
        if name.startswith(("logical", "maximum", "minimum", "atan2")):
            return
        check(lambda x: getattr(torch, name)(x, 2), value, kernels=1)
        check(lambda x: getattr(torch, name)(x, -0.7), value, kernels=1)
    else:
        check(getattr(torch, name), value, second[other], kernels=1)


@pytest.mark.parametrize("name", ["maximum", "minimum", "eq", "lt", "ge", "add", "mul"])
def test_numbers_that_are_not_finite_go_on(name):
    check(getattr(torch, name), ODD[:, None].expand(E, E).contiguous(), ODD.clone(), kernels=1)


@pytest.mark.parametrize(
    "name", ["add", "sub", "mul", "div", "remainder", "eq", "lt", "bitwise_and", "bitwise_or"]
)
def test_whole_numbers_and_bools(name):
    check(getattr(torch, name), whole(3), whole(3).abs() + 1, kernels=1, exact=True)
    if name.startswith(("bitwise", "mul", "add", "eq")):
        check(getattr(torch, name), whole(3) > 0, whole(3).flip(1) > 1, kernels=1, exact=True)
    if not name.startswith("bitwise"):
        check(getattr(torch, name), whole(3), floats(3) + 0.1, kernels=1)


CASES = {
    "where": lambda x: torch.where(x > 0, x, 2.0),
    "where of rows": lambda x: torch.where(x[:, :1] > 0, x, -x),
    "clamp": lambda x: x.clamp(-0.5, 0.7),
    "clamp from below": lambda x: x.clamp(min=-0.5),
    "clamp from above": lambda x: x.clamp(max=0.5),
    "clamp by tensors": lambda x: x.clamp(torch.full((4,), -0.2), torch.full((4,), 0.4)),
    "lerp": lambda x: torch.lerp(x, x * x, 0.3),
    "lerp beyond half": lambda x: torch.lerp(x, x * x, 0.8),
    "addcmul": lambda x: torch.addcmul(x, x, x, value=-0.3),
    "addcdiv": lambda x: torch.addcdiv(x, x, x.abs() + 1, value=0.3),
    "add with alpha": lambda x: torch.add(x, x * x, alpha=0.25),
    "sub with alpha": lambda x: torch.sub(x, x * x, alpha=0.25),
    "one minus": lambda x: 1.0 - x,
    "square": lambda x: x**2,
    "cube": lambda x: x**3,
    "root": lambda x: x.abs() ** 0.5,
    "masked fill": lambda x: x.masked_fill(x > 0, -1.0),
    "sum": lambda x: x.sum(-1),
    "sum that keeps the dim": lambda x: x.sum(1, keepdim=True),
    "mean": lambda x: x.view(E, 2, 2).mean((1, 2)),
    "norm": lambda x: torch.linalg.vector_norm(x, dim=-1),
    "most": lambda x: x.amax(-1) - x.amin(-1),
    "sum of nothing": lambda x: x[:, :0].sum(-1) + x[:, 0],
    "product": lambda x: x.prod(-1),
    "any": lambda x: (x > 0.5).any(-1) ^ (x > -1.0).all(-1),
    "count": lambda x: (x > 0).sum(-1),
    "cat": lambda x: torch.cat((x, x[:, 1:3], x * 2), dim=1),
    "stack": lambda x: torch.stack((x, -x), dim=1),
    "stack at the end": lambda x: torch.stack((x, -x), dim=-1),
    "split": lambda x: torch.cat(
        [part * k for k, part in enumerate(x.split([1, 3], dim=1))], dim=1
    ),
    "cross": lambda x: torch.linalg.cross(x[:, :3], x[:, 1:]),
    "columns by number": lambda x: x[:, torch.tensor([2, 0, -1])],
    "columns that are written": lambda x: put(x),
    "select of columns": lambda x: x.index_select(1, torch.tensor([3, 3, 0])),
    "gather": lambda x: x.gather(1, (x > 0).long()),
    "matrices": lambda x: (x.view(E, 2, 2) @ x.view(E, 2, 2)).squeeze(-1),
    "table": lambda x: TABLE[(x[:, 0] > 0).long() + 2 * (x[:, 1] > 0).long()],
    "table of several": lambda x: TABLE[(x > 0).long()],
    "transposed": lambda x: (x.view(E, 2, 2).transpose(1, 2) * x.view(E, 2, 2)).reshape(E, 4),
    "expanded": lambda x: (x[:, :1].expand(E, 5) * 2).contiguous(),
    "another type": lambda x: (x > 0).float() + x.double().float(),
    "fills": lambda x: (
        torch.zeros_like(x) + torch.ones(E, 4) * torch.full((E, 4), 0.25) + x.new_full((4,), 0.5)
    ),
}
TABLE = torch.arange(12.0).view(4, 3) * 0.1


def put(x):
    y = x.clone()
    y[:, torch.tensor([3, 0])] = x[:, 1:3]
    y[:, 1:2] += 5.0
    return y


@pytest.mark.parametrize("name", CASES)
def test_other_functions_of_rows(name):
    check(CASES[name], floats(4), kernels=1)


def test_what_is_written_in_place_is_written():
    def step(state, clock, mask):
        state.add_(0.5).mul_(2.0)
        state[:, 1].sub_(clock)
        clock.masked_fill_(mask, 0.0)
        state.copy_(torch.where(mask[:, None], -state, state))
        return state, clock

    check(step, floats(3), floats(), whole() > 0, kernels=1)


def test_old_values_are_read_before_new_ones_are_written():
    def swap(last, present, new):
        last.copy_(present)
        present.copy_(new)
        return last, present

    check(swap, floats(3), floats(3), floats(3) * 2, kernels=1, exact=True)


def test_rows_that_see_other_rows_are_left_to_torch():
    def centred(value):
        total = (value * 2.0).sum(0)
        return (value * 2.0 - total) + 1.0

    tape = check(centred, floats(3))
    assert len(tape.parts) > 1


def test_a_kernel_ends_before_rows_see_what_others_have_written():
    before = torch.arange(E).roll(1)

    def shifted(value):
        doubled = value * 2.0
        return doubled[before] + doubled

    tape = check(shifted, floats(3))
    assert kernels_of(tape) == [Kernel, Kernel]


def test_numbers_without_rows_are_worked_out_by_each_row_and_written_by_one():
    def scaled(value, weights):
        scale = weights * 0.5 + 1.0
        return value * scale, scale

    check(scaled, floats(3), torch.tensor([1.0, 2.0, 3.0]), kernels=1)


def test_numbers_without_rows_that_were_there_are_written_once():
    def counted(value, count):
        count.add_(1)
        return value + count, count

    tape = check(counted, floats(3), torch.tensor(4), exact=True)
    assert len(tape.parts) == 2 and not isinstance(tape.parts[0], Kernel)


def test_a_square_of_as_many_rows_as_columns_is_told_from_rows():
    check(lambda x, w: x * (w * 2.0) + w[:, None], floats(E), torch.arange(float(E)))


def test_launches_stand_where_they_stood():
    order = []

    def launch():
        order.append("launch")

    value = floats(3)
    with recording.recorded() as recorder:
        first = value * 2.0
        assert recording.launched(launch)
        second = first + 1.0
    tape = Tape(recorder, num_rows=E, returned=(second,))
    assert [isinstance(part, Kernel) for part in tape.parts] == [True, False, True]
    tape()
    assert order == ["launch", "launch"] and torch.equal(second, value * 2.0 + 1.0)
    assert not recording.launched(launch)


def test_buffers_of_one_arena_are_memory_of_their_own():
    arena = torch.zeros(E * 5)
    first, second = arena[: E * 2].view(E, 2), arena[E * 2 :].view(E, 3)

    def step(value):
        first.copy_(value[:, :2])
        second.add_(value)
        return first + 0.0, second + 0.0

    tape, *_ = taped(step, floats(3))
    assert kernels_of(tape) == [Kernel]


def test_what_the_host_reads_is_refused():
    with pytest.raises(RuntimeError, match="host"), recording.recorded():
        floats(3).sum().item()


def test_draws_are_part_of_the_kernel_and_follow_their_counters():
    def draw(value, seed, count, counts):
        by_step, by_row = (
            random.RowKeys(seed, 5, count, E, 3),
            random.RowKeys(seed, 9, counts, E, 0),
        )
        parts = (
            random.uniform(by_step, 2, -1.0, 3.0),
            random.normal(by_row, 3),
            random.integers(by_row, 1, -2, 4),
        )
        return torch.cat([value, *(part.float() for part in parts)], dim=1)

    check(draw, floats(1), torch.tensor(11), torch.tensor(2), whole().abs(), kernels=1)


def test_a_kernel_that_is_no_operator_of_torch_is_refused():
    quick = QuickLaunch(arguments_of((ADDRESS, "out")), "((float*)a.out)[row] = 1.0f;")
    with pytest.raises(AssertionError, match="no operator"), recording.recorded():
        quick(torch.device("cpu"), (E, 1), torch.empty(E).data_ptr())


def test_equal_functions_have_equal_sources(monkeypatch):
    sources = []

    def noted(arguments, source, **options):
        sources.append(source)
        return QuickLaunch(arguments, source, **options)

    monkeypatch.setattr("ksim_rl.compiled.tape.QuickLaunch", noted)
    for _ in range(2):
        taped_once(
            lambda x: torch.cat((x, torch.zeros(E, 0), (x * 2).sum(-1, keepdim=True)), dim=1)
        )
    assert sources[0] == sources[1]


def taped_once(function):
    with recording.recorded() as recorder:
        result = function(floats(3).clone())
    return Tape(recorder, num_rows=E, returned=(result,))


@pytest.mark.parametrize(
    ("value", "ctype", "written"),
    [
        (0.1, "float", "(float)0.1"),
        (math.inf, "float", "INFINITY"),
        (True, "bool", "(bool)1LL"),
        (3, "int", "(int)3LL"),
    ],
)
def test_numbers_of_python_in_cpp(value, ctype, written):
    assert cells.literal(value, ctype) == written


def test_memory_that_only_a_kernel_uses_is_given_back_and_other_memory_kept():
    held = []

    def function(x):
        # The kernel of the case "most".
        ends = (x.amax(-1), x.amin(-1))
        result = ends[0] - ends[1]
        held.extend(weakref.ref(one.untyped_storage()) for one in (*ends, result, x))
        return result

    x = floats(4)
    # Behind the beginning of its storage, which nothing else keeps.
    inputs = [torch.cat((x, x))[E:]]
    with recording.recorded() as recorder:
        returned = function(inputs.pop())
    tape = Tape(recorder, num_rows=E, returned=(returned,))
    del recorder
    gc.collect()
    assert [one() is None for one in held] == [True, True, False, False]
    returned.zero_()
    tape()
    torch.testing.assert_close(returned, x.amax(-1) - x.amin(-1))
