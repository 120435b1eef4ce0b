import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import ValueOperator

from ksim_rl.modules import CriticCfg, make_critic
from ksim_rl.testing import count_syncs


@pytest.mark.parametrize("obs_normalization", [True, False])
@pytest.mark.parametrize("shape", [(4,), (4, 3)])
def test_writes_state_value(shape, obs_normalization):
    critic = make_critic(
        CriticCfg(hidden_dims=(16, 8), obs_normalization=obs_normalization), obs_dim=5
    )
    assert isinstance(critic, ValueOperator)
    data = TensorDict({"critic": torch.randn(*shape, 5)}, shape)
    with count_syncs() as syncs:
        out = critic(data)
    assert syncs.total == 0, syncs.report()
    assert out["state_value"].shape == (*shape, 1)


def test_reads_the_key_it_is_given():
    critic = make_critic(CriticCfg(hidden_dims=(8,), in_keys=("privileged",)), obs_dim=5)
    assert critic.in_keys == ["privileged"]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"hidden_dims": (-3,)}, r"hidden_dims\[0\]=-3"),
        ({"activation": "tan"}, "activation='tan'.*'tanh'"),
        ({"output_gain": float("inf")}, "output_gain=inf"),
    ],
)
def test_config_refusals_name_the_field(kwargs, message):
    with pytest.raises(ValueError, match=message):
        CriticCfg(**kwargs)
