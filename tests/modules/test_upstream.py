"""What modules uses beyond the documents of other libraries is still there; each failure names what moved."""

import sys

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded

from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    DeterministicActorCfg,
    QNetworkCfg,
    SharedTrunkCfg,
    SquashedActorCfg,
    make_actor,
    make_critic,
    make_deterministic_actor,
    make_q_network,
    make_shared_trunk,
    make_squashed_actor,
    upstream,
)

SPEC = Bounded(-1.0, 1.0, (2,))
MODULES = {
    "actor": lambda: make_actor(ActorCfg(), obs_dim=3, action_spec=SPEC),
    "critic": lambda: make_critic(CriticCfg(), obs_dim=3),
    "deterministic actor": lambda: make_deterministic_actor(
        DeterministicActorCfg(), obs_dim=3, action_spec=SPEC
    ),
    "action values": lambda: make_q_network(QNetworkCfg(), obs_dim=3, action_dim=2),
    "shared trunk": lambda: make_shared_trunk(SharedTrunkCfg(in_keys=("actor",)), obs_dim=3),
    "squashed actor": lambda: make_squashed_actor(SquashedActorCfg(), obs_dim=3, action_spec=SPEC),
}


@pytest.fixture
def pandas_asked_for(monkeypatch, tmp_path):
    """A pandas that cannot be imported: whoever does raises."""
    (tmp_path / "pandas.py").write_text("raise ImportError('pandas was asked for')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pandas", raising=False)


def observed():
    return TensorDict(
        {"actor": torch.rand(4, 3), "critic": torch.rand(4, 3), "action": torch.rand(4, 2)}, [4]
    )


@pytest.mark.parametrize("build", MODULES.values(), ids=MODULES)
def test_networks_write_without_pandas(build, pandas_asked_for):
    module, td = build(), observed()
    module(td)
    assert all(td.get(key).shape[0] == 4 for key in module.out_keys)


def test_the_module_of_tensordict_still_imports_pandas(pandas_asked_for):
    with pytest.raises(ImportError, match="pandas was asked for"):
        TensorDictModule(nn.Linear(3, 1), in_keys=["actor"], out_keys=["value"])(observed())


def test_a_module_of_tensors_writes_what_that_of_tensordict_writes():
    keys = {"in_keys": ["actor"], "out_keys": ["low", ("nested", "high")]}
    ours, theirs = (
        kind(lambda x: (x - 1.0, x + 1.0), **keys)
        for kind in (upstream.TensorModule, TensorDictModule)
    )
    td = observed()
    assert (ours(td.clone()) == theirs(td.clone())).all()
    assert ours(td, tensordict_out=TensorDict(batch_size=[4])).sorted_keys == ["low", "nested"]
    assert td.sorted_keys == ["action", "actor", "critic"]
    with pytest.raises(ValueError, match="zip"):
        upstream.TensorModule(lambda x: (x, x, x), **keys)(td)
    with pytest.raises(AssertionError, match="into what they read"):
        upstream.TensorModule(lambda x: (x, x), **keys, inplace=False)(td)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("fused_lstm_cell", "input_gates hidden_gates cx input_bias hidden_bias"),
        ("fused_lstm_cell_backward", "grad_hy grad_cy cx cy workspace has_bias"),
        ("fused_gru_cell", "input_gates hidden_gates hx input_bias hidden_bias"),
        ("fused_gru_cell_backward", "grad_hy workspace has_bias"),
    ],
)
def test_the_kernels_of_recurrent_cells_take_the_same_arguments(name, arguments):
    schema = getattr(upstream, name).default._schema
    assert " ".join(argument.name for argument in schema.arguments) == arguments, schema
