"""The kernels of norms, run by Triton's interpreter, beside torch in float64, and layers that use them."""

import sys

import pytest
import torch
from torch import nn
from torch.nn import functional

from ksim_rl.modules.mlp import Layers, mlp

pytest.importorskip("triton", reason="Triton is not installed")
pytestmark = pytest.mark.skipif(
    torch.cuda.is_available(), reason="tests/gpu runs the kernels themselves"
)
# By the numbers of the kernels.
ACTIVATIONS = (lambda value: value, functional.relu, functional.silu)


def _gradients(function, inputs, weights):
    inputs = [value.detach().requires_grad_() for value in inputs]
    out = function(*inputs)
    return out, *torch.autograd.grad((out * weights.to(out.dtype)).sum(), inputs)


@pytest.mark.parametrize(
    ("shape", "activation"),
    [
        ((2, 70, 24), 2),
        ((1, 33, 20), 1),
        ((3, 5, 48), 0),
        ((3, 5, 64), 0),
        ((2, 19, 128), 2),
        ((1, 3, 300), 2),
        pytest.param((2, 41, 520), 2, marks=pytest.mark.full),
        ((1, 3, 1000), 2),
    ],
)
def test_values_and_gradients_are_those_of_torch(shape, activation):
    from ksim_rl.modules.norm_kernels import Normalized

    networks, _, width = shape
    features = 2.0 * torch.randn(shape) + 1.0
    weights = [torch.randn(networks, 1, width) for _ in range(3)]
    d_out = torch.randn(shape)

    def expected(features, bias, gain, offset):
        return ACTIVATIONS[activation](
            functional.layer_norm(features + bias, (width,)) * gain + offset
        )

    def ours(*inputs):
        return Normalized.apply(*inputs, activation)

    exact = _gradients(expected, [value.double() for value in (features, *weights)], d_out)
    found = _gradients(ours, (features, *weights), d_out)
    for one, other in zip(found, exact, strict=True):
        assert (one - other).norm() < 1e-6 * other.norm()
    assert all(map(torch.equal, found, _gradients(ours, (features, *weights), d_out)))
    half = _gradients(ours, (features.bfloat16(), *weights), d_out)
    assert half[0].dtype == half[1].dtype == torch.bfloat16 and half[2].dtype == torch.float32
    for one, other in zip(half, exact, strict=True):
        # bfloat16 rounds what comes in and goes out by up to 0.4 % each.
        assert (one - other).norm() < 0.01 * other.norm()


@pytest.mark.parametrize(
    ("activation", "num_networks"),
    [
        ("silu", None),
        ("relu", 2),
        ("mish", 2),
        pytest.param("silu", 2, marks=pytest.mark.full),
        pytest.param("relu", None, marks=pytest.mark.full),
        pytest.param("mish", None, marks=pytest.mark.full),
    ],
)
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


@pytest.mark.parametrize("learns", [False, True])
def test_networks_that_read_the_same_give_what_they_give_for_copies(learns, monkeypatch):
    layers = mlp(61, (24,), 13, num_networks=2, layer_norm=True).requires_grad_(learns)
    inputs = torch.randn(8, 61, requires_grad=True)
    module, cast = sys.modules[Layers.__module__], []
    padded = vars(module)["_padded"]
    monkeypatch.setattr(module, "rounds", lambda features: True)
    monkeypatch.setattr(
        module, "_padded", lambda own, *given: cast.append(own) or padded(own, *given)
    )

    def run(features):
        out = layers(features).float().square().sum()
        return out, *torch.autograd.grad(out, [inputs, *(layers.parameters() if learns else ())])

    found = run(inputs[None])
    assert len(cast[0]) == (2 if learns else 1)
    for one, other in zip(found, run(inputs.expand(2, -1, -1).contiguous()), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
