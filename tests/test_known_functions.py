"""Functions whose code is kept give a module the text that they give when Warp generates their code again."""

import warp as wp
from warp._src.context import Function, ModuleBuilder


@wp.struct
class Pair:
    first: float
    second: float


@wp.func
def doubled(value: float):
    return value * 2.0


@wp.func
def difference(first: float, second: float):
    # A struct that no kernel names.
    pair = Pair()
    pair.first = first
    pair.second = second
    return doubled(pair.first) - pair.second


@wp.kernel(module="unique")
def subtract(values: wp.array[float]):
    index = wp.tid()
    values[index] = difference(values[index], 1.0)


@wp.kernel(module="unique")
def double(values: wp.array[float]):
    values[0] = doubled(difference(2.0, values[0]))


def text_of(kernel: wp.Kernel, block_dim: int) -> str:
    options = kernel.module.resolve_options(wp.config)
    options |= {"block_dim": block_dim, "output_arch": None}
    return ModuleBuilder(kernel.module, options, target="cpu").codegen("cpu")


def test_a_module_has_the_same_text_and_no_function_is_looked_at_twice(monkeypatch):
    looked_at = []
    build = Function.build

    def noted(function: Function, *args, **options) -> None:
        looked_at.append(function.key)
        build(function, *args, **options)

    monkeypatch.setattr(Function, "build", noted)
    text_of(subtract, block_dim=256)
    assert looked_at == ["difference", "doubled"]
    texts = [text_of(kernel, block_dim=1) for kernel in (subtract, double)]
    assert looked_at == ["difference", "doubled"]
    # As Warp does it by itself.
    monkeypatch.setattr(ModuleBuilder, "build_function", ModuleBuilder.build_function.__wrapped__)
    assert texts == [text_of(kernel, block_dim=1) for kernel in (subtract, double)]
    assert looked_at == ["difference", "doubled"] * 3
