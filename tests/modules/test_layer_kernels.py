"""The kernels of layers, run by Triton's interpreter, beside torch in float64, and networks that use them."""

import math
import sys
from functools import partial

import pytest
import torch
from torch import nn
from torch.nn import functional

from ksim_rl.modules.mlp import Layers, mlp

pytest.importorskip("triton", reason="Triton is not installed")
pytestmark = pytest.mark.skipif(torch.cuda.is_available(), reason="tests/gpu runs the kernels themselves")
# By the numbers of the kernels.
ACTIVATIONS = (lambda value: value, functional.relu, functional.silu)


@pytest.fixture(params=[False, True])
def joined(request, monkeypatch):
    """One kernel, or two; the kernel of the other way is not there."""
    from triton import language as tl
    from triton.runtime.interpreter import InterpreterBuilder

    from ksim_rl.modules import layer_kernels

    monkeypatch.setattr(layer_kernels, "JOINS", request.param)
    monkeypatch.setattr(layer_kernels, "normalize_rows" if request.param else "multiply_and_normalize", None)
    dot = InterpreterBuilder.create_dot

    def exact_dot(self, *operands):
        # The interpreter multiplies the bits of bfloat16 as integers.
        ones = [
            self.cast_impl(one, tl.float32) if one.dtype.scalar == tl.bfloat16 else one
            for one in operands[:2]
        ]
        return dot(self, *ones, *operands[2:])

    monkeypatch.setattr(InterpreterBuilder, "create_dot", exact_dot)
    return request.param


def _gradients(function, inputs, weights):
    inputs = [value.detach().requires_grad_() for value in inputs]
    out = function(*inputs)
    return out, *torch.autograd.grad((out * weights.to(out.dtype)).sum(), inputs)


@pytest.mark.usefixtures("joined")
@pytest.mark.parametrize(
    ("shape", "activation"),
    [
        ((2, 70, 40, 24), 2),
        ((1, 33, 13, 20), 1),
        ((3, 5, 8, 48), 0),
        ((1, 3, 99, 300), 2),
        ((2, 131, 70, 520), 2),
    ],
)
def test_values_and_gradients_are_those_of_torch(shape, activation):
    from ksim_rl.modules.layer_kernels import Layer

    networks, rows, fan_in, width = shape
    features, d_out = 2.0 * torch.randn(networks, rows, fan_in) + 1.0, torch.randn(networks, rows, width)
    weight = torch.randn(networks, fan_in, width) / math.sqrt(fan_in)
    vectors = [torch.randn(networks, 1, width) for _ in range(3)]

    def expected(features, weight, bias, gain, offset):
        standardized = functional.layer_norm(features @ weight + bias, (width,))
        return ACTIVATIONS[activation](standardized * gain + offset)

    def ours(features, weight, *vectors, dtype=torch.float32):
        rounded = functional.pad(weight.detach(), (0, -width % 8, 0, -fan_in % 8)).to(dtype)
        return Layer.apply(features, weight, rounded, True, *vectors, activation)

    exact = _gradients(expected, [value.double() for value in (features, weight, *vectors)], d_out)
    found = _gradients(ours, (features, weight, *vectors), d_out)
    for one, other in zip(found, exact, strict=True):
        assert (one - other).norm() < 3e-6 * other.norm()
    assert all(map(torch.equal, found, _gradients(ours, (features, weight, *vectors), d_out)))
    features, weight = (value.bfloat16().float() for value in (features, weight))
    exact = _gradients(expected, [value.double() for value in (features, weight, *vectors)], d_out)
    half = _gradients(partial(ours, dtype=torch.bfloat16), (features, weight, *vectors), d_out)
    assert half[0].dtype == torch.bfloat16 and half[1].dtype == half[2].dtype == torch.float32
    for one, other in zip(half, exact, strict=True):
        # bfloat16 rounds features, gradients and outputs by up to 0.4 % each.
        assert (one - other).norm() < 0.015 * other.norm()


def test_one_kernel_writes_outputs_alone_where_nothing_learns():
    from ksim_rl.modules.layer_kernels import _tile, multiply_and_normalize

    networks, rows, fan_in, width = 2, 70, 16, 24
    given, weights = torch.randn(networks, rows, fan_in), torch.randn(networks, fan_in, width)
    vectors = torch.randn(3, networks, width)
    written = []
    for kept in (False, True):
        # One row more than there is.
        results = [torch.full((networks * rows + 1, size), 7.0) for size in (width, 2, width)]
        sizes = rows, rows * fan_in, 2, kept, fan_in, width
        multiply_and_normalize[2, networks](
            given, weights, *vectors, *results, *sizes, **_tile(networks * rows, fan_in, width)
        )
        written.append(results)
    assert all(bool((result == 7.0).all()) for result in written[0][:2])
    assert torch.equal(written[0][2], written[1][2])
    for result in written[1]:
        assert (result[-1] == 7.0).all() and not (result[:-1] == 7.0).any()


@pytest.mark.usefixtures("joined")
@pytest.mark.parametrize("num_networks", [None, 2])
@pytest.mark.parametrize("activation", ["silu", "relu", "mish"])
def test_layers_in_half_precision_err_as_torch_does(num_networks, activation, monkeypatch):
    options = {"activation": activation, "layer_norm": True, "num_networks": num_networks}
    layers = mlp(61, (48, 24), 13, **options)
    assert isinstance(layers, Layers)
    for parameter in layers.parameters():
        parameter.data.add_(0.1 * torch.randn_like(parameter))
    inputs = 3.0 * torch.randn(*(() if num_networks is None else (num_networks,)), 64, 61)

    def run(dtype=torch.bfloat16):
        with torch.autocast("cpu", torch.bfloat16, enabled=dtype is torch.bfloat16):
            out = layers(inputs)
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=dtype is torch.bfloat16):
            assert torch.equal(layers(inputs), out)
        return out, *torch.autograd.grad(out.float().square().mean(), list(layers.parameters()))

    exact, of_torch = run(torch.float32), run()
    # What CUDA does under autocast.
    monkeypatch.setattr(sys.modules[Layers.__module__], "rounds", lambda features: True)
    ours = run()
    assert ours[0].dtype == torch.bfloat16 and ours[0].shape == exact[0].shape
    # Autograd would copy gradients that lie in memory otherwise than their parameters.
    for gradient, parameter in zip(ours[1:], layers.parameters(), strict=True):
        assert gradient.stride() == parameter.stride()
    for one, plain, true in zip(ours, of_torch, exact, strict=True):
        allowed = max(0.02, 1.5 * float((plain - true).norm() / true.norm()))
        assert (one - true).norm() < allowed * true.norm()


def test_layers_without_a_norm_are_products(monkeypatch):
    layers = mlp(7, (9,), 3, num_networks=2)
    inputs = torch.randn(2, 12, 7)
    expected = layers(inputs)
    monkeypatch.setattr(sys.modules[Layers.__module__], "rounds", lambda features: True)
    assert (layers(inputs) - expected).norm() < 0.02 * expected.norm()
    assert isinstance(layers[:2], Layers) and isinstance(mlp(7, (9,), 3), nn.Sequential)


@pytest.mark.usefixtures("joined")
@pytest.mark.parametrize("learns", [False, True])
def test_networks_that_read_the_same_give_what_they_give_for_copies(learns, monkeypatch):
    layers = mlp(61, (24,), 13, num_networks=2, layer_norm=True).requires_grad_(learns)
    inputs = torch.randn(8, 61, requires_grad=True)
    from ksim_rl.modules import layer_kernels

    cast, padded = [], vars(layer_kernels)["_padded"]
    monkeypatch.setattr(sys.modules[Layers.__module__], "rounds", lambda features: True)
    monkeypatch.setattr(layer_kernels, "_padded", lambda own, *given: cast.append(own) or padded(own, *given))

    def run(features):
        out = layers(features).float().square().sum()
        return out, *torch.autograd.grad(out, [inputs, *(layers.parameters() if learns else ())])

    found = run(inputs[None])
    assert len(cast[0]) == (2 if learns else 1)
    for one, other in zip(found, run(inputs.expand(2, -1, -1).contiguous()), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
