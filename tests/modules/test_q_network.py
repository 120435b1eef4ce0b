"""Ensembles against networks that are evaluated one by one."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from ksim_rl.modules import QNetworkCfg, make_q_network
from ksim_rl.modules.mlp import mlp


def _alone(layers, which):
    """Return one network of an ensemble, made of torch's layers."""
    alone = nn.Sequential()
    for layer in layers:
        if layer.__class__.__name__ == "EnsembleLinear":
            own = nn.Linear(*layer.weight.shape[1:])
            own.weight.data.copy_(layer.weight[which].T)
        elif layer.__class__.__name__ == "EnsembleLayerNorm":
            own = nn.LayerNorm(layer.dim)
            own.weight.data.copy_(layer.weight[which, 0])
        else:
            alone.append(layer)
            continue
        own.bias.data.copy_(layer.bias[which, 0])
        alone.append(own)
    return alone


@pytest.mark.parametrize("layer_norm", [False, True])
def test_an_ensemble_is_its_networks(layer_norm):
    torch.manual_seed(0)
    ensemble = mlp(5, (16, 8), 2, num_networks=3, activation="silu", layer_norm=layer_norm)
    for parameter in ensemble.parameters():
        parameter.data.add_(0.1 * torch.randn_like(parameter))
    inputs = torch.randn(3, 7, 5)
    for which in range(3):
        torch.testing.assert_close(ensemble(inputs)[which], _alone(ensemble, which)(inputs[which]))


def test_networks_start_different_orthogonal_and_with_zero_biases():
    first = mlp(6, (16,), 1, num_networks=2)[0]
    assert not torch.equal(first.weight[0], first.weight[1]) and not first.bias.any()
    for weight in first.weight:
        torch.testing.assert_close(weight @ weight.T, 2.0 * torch.eye(6))


@pytest.mark.parametrize(
    ("num_atoms", "key"), [(1, "state_action_value"), (7, "state_action_logits")]
)
@pytest.mark.parametrize("batch", [[4], [2, 3]])
def test_shapes_and_keys(num_atoms, key, batch):
    cfg = QNetworkCfg(hidden_dims=(8,), num_networks=3, num_atoms=num_atoms, v_min=-1.0, v_max=2.0)
    network = make_q_network(cfg, obs_dim=5, action_dim=2)
    td = network(
        TensorDict({"critic": torch.randn(*batch, 5), "action": torch.randn(*batch, 2)}, batch)
    )
    assert td[key].shape == torch.Size([*batch, 3] + ([7] if num_atoms > 1 else []))
    support = network.module.support
    assert (
        support is None
        if num_atoms == 1
        else support.tolist() == [-1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0]
    )
    one = network.module(td["critic"].reshape(-1, 5)[:1], td["action"].reshape(-1, 2)[:1])
    torch.testing.assert_close(td[key].flatten(0, len(batch) - 1)[0], one[0])


@pytest.mark.parametrize(
    "field", [{"num_networks": 0}, {"num_atoms": 0}, {"v_min": 5.0, "v_max": 5.0}]
)
def test_what_it_refuses(field):
    with pytest.raises(ValueError, match=next(iter(field))):
        QNetworkCfg(**field)
