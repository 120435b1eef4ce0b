import pytest
import torch

from ksim_rl.modules import ACTIVATIONS, mlp


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_shapes_and_layers(activation):
    network = mlp(5, (16, 8), 3, activation=activation)
    assert network(torch.zeros(2, 4, 5)).shape == (2, 4, 3)
    widths = [layer.weight.shape for layer in network if isinstance(layer, torch.nn.Linear)]
    assert widths == [(16, 5), (8, 16), (3, 8)]
    assert isinstance(network[1], ACTIVATIONS[activation])
    assert isinstance(network[-1], torch.nn.Linear)


def test_no_hidden_layer_is_linear():
    network = mlp(5, (), 3)
    x, y = torch.randn(2, 7, 5)
    bias = network(torch.zeros(5))
    torch.testing.assert_close(network(x + y) - bias, network(x) - bias + network(y) - bias)


def test_weights_are_orthogonal_with_the_gains():
    network = mlp(32, (32, 32), 32, output_gain=0.01)
    weights = [layer.weight for layer in network if isinstance(layer, torch.nn.Linear)]
    for weight, gain in zip(weights, (2.0**0.5, 2.0**0.5, 0.01), strict=True):
        torch.testing.assert_close(weight @ weight.T, gain**2 * torch.eye(32), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"hidden_dims": (16, 0)}, r"hidden_dims\[1\]=0"),
        ({"hidden_dims": (16, 2.5)}, r"hidden_dims\[1\]=2.5"),
        ({"hidden_dims": (16,), "activation": "elo"}, "activation='elo'.*'elu'"),
        ({"hidden_dims": (16,), "output_gain": float("nan")}, "output_gain=nan"),
    ],
)
def test_refusals_name_the_field(kwargs, message):
    with pytest.raises(ValueError, match=message):
        mlp(4, output_dim=2, **kwargs)
