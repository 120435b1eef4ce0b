"""LSTM and GRU against `torch.nn`, episode by episode, and in TorchRL's envs."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import GRUModule, LSTMModule, set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module

from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    RecurrentCfg,
    RecurrentModule,
    RecurrentNetwork,
    behind,
    make_recurrent_actor,
    make_recurrent_critic,
    recurrent_modules,
    recurrent_transforms,
    update_normalizers,
)
from ksim_rl.modules.recurrent_cells import GRU, LSTM
from ksim_rl.testing import count_syncs
from ksim_rl.testing.counter_env import CounterEnv

T, B, OBS, H = 9, 4, 3, 5
TRUTH = {"lstm": nn.LSTM, "gru": nn.GRU}
kinds = pytest.mark.parametrize("kind", ["lstm", "gru"])
layers = pytest.mark.parametrize("num_layers", [1, 2])


def pair(kind, num_layers):
    """Our network and torch's, with the same random parameters."""
    torch.manual_seed(0)
    theirs = TRUTH[kind](OBS, H, num_layers).double()
    ours = RecurrentNetwork(
        RecurrentCfg(kind=kind, hidden_dim=H, num_layers=num_layers), obs_dim=OBS
    ).double()
    ours.load_state_dict(theirs.state_dict())
    obs_TB = torch.randn(T, B, OBS, dtype=torch.float64, requires_grad=True)
    num_parts = 2 if kind == "lstm" else 1
    state_BN = tuple(
        torch.randn(B, num_layers, H, dtype=torch.float64, requires_grad=True)
        for _ in range(num_parts)
    )
    return ours, theirs, obs_TB, state_BN


def run_truth(theirs, obs_TB, state_BN):
    """Return torch's features, and its last state in our layout."""
    state_NB = tuple(part.transpose(0, 1).contiguous() for part in state_BN)
    features_TB, last = theirs(obs_TB, state_NB if len(state_NB) == 2 else state_NB[0])
    last = last if isinstance(last, tuple) else (last,)
    return features_TB, tuple(part.transpose(0, 1) for part in last)


def gradients(features_TB, last, leaves):
    """Return the gradients of a loss that sees each feature, and the last state, differently."""
    weight = torch.linspace(-1.0, 2.0, features_TB.numel(), dtype=torch.float64).view_as(
        features_TB
    )
    loss = (features_TB * weight).sum() + sum((part.sin() * weight[0, 0, 0]).sum() for part in last)
    return torch.autograd.grad(loss, leaves)


def assert_same(actual, expected):
    for one, other in zip(actual, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-12, rtol=1e-12)


@kinds
@layers
def test_without_resets_outputs_and_gradients_are_those_of_torch(kind, num_layers):
    ours, theirs, obs_TB, state_BN = pair(kind, num_layers)
    features_TB, states_TB = ours(obs_TB, state_BN)
    expected_TB, expected_last = run_truth(theirs, obs_TB, state_BN)
    last = tuple(part[-1] for part in states_TB)
    assert_same((features_TB, *last), (expected_TB, *expected_last))
    leaves = [obs_TB, *state_BN]
    assert_same(
        gradients(features_TB, last, [*leaves, *ours.parameters()]),
        gradients(expected_TB, expected_last, [*leaves, *theirs.parameters()]),
    )


@kinds
@layers
def test_with_resets_each_episode_is_as_if_it_were_alone(kind, num_layers):
    ours, theirs, obs_TB, state_BN = pair(kind, num_layers)
    starts = [[0, 4], [3, 4, 8], [], [0, 1, 2]]
    reset_TB1 = torch.zeros(T, B, 1, dtype=torch.bool)
    for row, steps in enumerate(starts):
        reset_TB1[steps, row] = True
    features_TB, states_TB = ours(obs_TB, state_BN, reset_TB1)

    columns, lasts = [], []
    for row, steps in enumerate(starts):
        state = tuple(part[row : row + 1] for part in state_BN)
        features = []
        for begin, end in zip([0, *steps], [*steps, T], strict=True):
            if begin in steps:
                state = tuple(torch.zeros_like(part) for part in state)
            if end > begin:
                piece, state = run_truth(theirs, obs_TB[begin:end, row : row + 1], state)
                features.append(piece)
        columns.append(torch.cat(features))
        lasts.append(state)
    expected_TB = torch.cat(columns, 1)
    expected_last = tuple(torch.cat(parts) for parts in zip(*lasts, strict=True))
    last = tuple(part[-1] for part in states_TB)
    assert_same((features_TB, *last), (expected_TB, *expected_last))
    leaves = [obs_TB, *state_BN]
    assert_same(
        gradients(features_TB, last, [*leaves, *ours.parameters()]),
        gradients(expected_TB, expected_last, [*leaves, *theirs.parameters()]),
    )


@kinds
def test_gradients_are_those_of_finite_differences(kind):
    torch.manual_seed(1)
    gates = {"lstm": 4, "gru": 3}[kind]
    shapes = [(3, 2, gates * 2), (gates * 2, 2), (2, 2), (2, 2)]
    gates_TB, weight, *state = (
        torch.randn(s, dtype=torch.float64, requires_grad=True) for s in shapes
    )
    reset_TB1 = torch.tensor([[False, False], [True, False], [False, False]])[..., None]
    bias = torch.randn(gates * 2, dtype=torch.float64, requires_grad=True)
    if kind == "lstm":
        assert torch.autograd.gradcheck(
            lambda *x: LSTM.apply(*x, reset_TB1), (gates_TB, weight, *state)
        )
    else:
        assert torch.autograd.gradcheck(
            lambda *x: GRU.apply(*x, reset_TB1), (gates_TB, weight, bias, state[0])
        )


@kinds
def test_autocast_rounds_the_inputs_only(kind):
    ours, _, obs_TB, state_BN = pair(kind, 1)
    ours, obs_TB, state_BN = (
        ours.float(),
        obs_TB.detach().float(),
        tuple(p.detach().float() for p in state_BN),
    )
    expected_TB, _ = ours(obs_TB, state_BN)
    with torch.autocast("cpu", torch.bfloat16):
        features_TB, _ = ours(obs_TB, state_BN)
    assert features_TB.dtype == torch.float32 and not torch.equal(features_TB, expected_TB)
    torch.testing.assert_close(features_TB, expected_TB, atol=0.03, rtol=0.0)
    features_TB.sum().backward()
    assert all(parameter.grad is not None for parameter in ours.parameters())


@kinds
def test_a_state_that_is_not_finite_ends_with_its_episode(kind):
    ours, _, obs_TB, state_BN = pair(kind, 1)
    broken = tuple(part.detach().index_fill(0, torch.tensor([1]), torch.nan) for part in state_BN)
    reset_TB1 = torch.zeros(T, B, 1, dtype=torch.bool)
    reset_TB1[2, 1] = True
    features_TB, _ = ours(obs_TB, broken, reset_TB1)
    assert features_TB[:2, 1].isnan().all() and features_TB[2:].isfinite().all()


def test_initial_weights_are_orthogonal_per_gate_and_the_forget_gate_is_open():
    network = RecurrentNetwork(RecurrentCfg(hidden_dim=6), obs_dim=4)
    for gate_HH in network.get_parameter("weight_hh_l0").chunk(4):
        torch.testing.assert_close(gate_HH @ gate_HH.T, torch.eye(6))
    bias = network.get_parameter("bias_ih_l0") + network.get_parameter("bias_hh_l0")
    assert bias.view(4, 6).tolist() == [[0.0] * 6, [1.0] * 6, [0.0] * 6, [0.0] * 6]


# -- in envs -----------------------------------------------------------------------------------------------------------


def policy(kind="lstm", *, in_keys=("drawn", "row")):
    """Return a policy of both observations, and its recurrent. Each episode draws another observation."""
    torch.manual_seed(0)
    recurrent = RecurrentModule(
        RecurrentCfg(kind=kind, hidden_dim=H, num_layers=2),
        obs_dim=2,
        in_keys=in_keys,
        name="actor",
    )
    head = TensorDictModule(
        nn.Sequential(nn.Linear(H, 2), nn.Tanh()),
        in_keys=[recurrent.feature_key],
        out_keys=["action"],
    )
    return behind(recurrent, head), recurrent


def primed(env, recurrent):
    for transform in recurrent_transforms(env, recurrent.make_tensordict_primer()):
        env.append_transform(transform)
    env.set_seed(1)
    return env


@torch.no_grad()
def rolled_out(env, actor, steps=12):
    return env.rollout(steps, actor, break_when_any_done=False)


@kinds
def test_a_rollout_equals_that_of_torchrls_module_in_torchrls_env(kind):
    actor, recurrent = policy(kind, in_keys=("obs_2",))
    cls, attribute = {"lstm": (LSTMModule, "lstm"), "gru": (GRUModule, "gru")}[kind]
    states = ["h", "c"][: len(recurrent.state_keys)]
    stock = cls(
        2,
        H,
        num_layers=2,
        in_keys=["obs_2", *states],
        out_keys=["features", *(("next", s) for s in states)],
    )
    getattr(stock, attribute).load_state_dict(recurrent.module.state_dict())
    head = TensorDictModule(actor[1].module, in_keys=["features"], out_keys=["action"])
    stock_actor = TensorDictSequential(stock, head)
    stock_env = TransformedEnv(TwoObservations(), InitTracker())
    stock_env.append_transform(stock.make_tensordict_primer())
    stock_env.set_seed(1)

    expected_ET = rolled_out(stock_env, stock_actor)
    for env_class in (MaskedTransformedEnv, TransformedEnv):
        rollout_ET = rolled_out(primed(env_class(TwoObservations()), recurrent), actor)
        torch.testing.assert_close(
            rollout_ET["action"], expected_ET["action"], atol=1e-6, rtol=1e-6
        )
        for key, stock_key in zip(recurrent.state_keys, states, strict=True):
            torch.testing.assert_close(
                rollout_ET[key], expected_ET[stock_key], atol=1e-6, rtol=1e-6
            )
            torch.testing.assert_close(
                rollout_ET[("next", *key)], expected_ET["next", stock_key], atol=1e-6, rtol=1e-6
            )
    assert expected_ET["is_init"].sum() > 6


class TwoObservations(CounterEnv):
    """Observes (count, drawn) as one vector."""

    def __init__(self):
        super().__init__([3, 5, 4])
        spec = self.full_observation_spec["obs", "vector"][..., :2].clone()
        self.full_observation_spec["obs_2"] = spec

    def _observe(self):
        seen = super()._observe()
        return seen | {"obs_2": torch.cat([0.1 * seen["count"], seen["drawn"]], -1)}


@kinds
def test_state_begins_at_zero_and_never_leaks_over_a_reset(kind):
    actor, recurrent = policy(kind)
    check_env_specs(primed(MaskedTransformedEnv(CounterEnv([3, 5, 4])), recurrent))
    rollout_ET = rolled_out(primed(MaskedTransformedEnv(CounterEnv([3, 5, 4])), recurrent), actor)
    is_init_ET, ends_ET = rollout_ET["is_init"][..., 0], rollout_ET["next", "done"][..., 0]
    assert torch.equal(is_init_ET[:, 1:], ends_ET[:, :-1]) and is_init_ET[:, 1:].any()
    for key in recurrent.state_keys:
        states_ET = rollout_ET[key].flatten(2)
        assert (states_ET[is_init_ET] == 0.0).all() and (states_ET[~is_init_ET] != 0.0).all()
        # What a step writes is what the next one reads, but for resets.
        carried_ET = ~is_init_ET[:, 1:]
        assert torch.equal(
            states_ET[:, 1:][carried_ET], rollout_ET[("next", *key)].flatten(2)[:, :-1][carried_ET]
        )
    # Another past of the envs changes nothing after their first reset.
    other = primed(MaskedTransformedEnv(CounterEnv([3, 5, 4])), recurrent)
    root_E = other.reset()
    for key in recurrent.state_keys:
        root_E.set(key, torch.full_like(root_E[key], 9.0))
    root_E["is_init"].zero_()
    with torch.no_grad():
        other_ET = other.rollout(
            12, actor, break_when_any_done=False, auto_reset=False, tensordict=root_E
        )
    for row, length in enumerate([3, 5, 4]):
        assert not torch.equal(other_ET["action"][row, :length], rollout_ET["action"][row, :length])
        assert torch.equal(other_ET["action"][row, length:], rollout_ET["action"][row, length:])


@kinds
def test_sequences_give_what_the_steps_gave(kind):
    actor, recurrent = policy(kind)
    rollout_ET = rolled_out(primed(MaskedTransformedEnv(CounterEnv([3, 5, 4])), recurrent), actor)
    read_ET = rollout_ET.select(*actor.in_keys)
    for start in (0, 4):
        with torch.no_grad(), set_recurrent_mode(True):
            unrolled_ET = actor(read_ET[:, start:].clone())
        torch.testing.assert_close(
            unrolled_ET["action"], rollout_ET["action"][:, start:], atol=1e-6, rtol=1e-6
        )
    # Without the marks of new episodes they would not: the comparison can fail.
    read_ET["is_init"].zero_()
    with torch.no_grad(), set_recurrent_mode(True):
        leaked_ET = actor(read_ET)
    assert not torch.allclose(leaked_ET["action"], rollout_ET["action"], atol=1e-3)


def test_a_step_makes_no_host_sync():
    actor, recurrent = policy()
    env = primed(MaskedTransformedEnv(CounterEnv([3, 5, 4])), recurrent)
    with torch.no_grad():
        _, root_E = env.step_and_maybe_reset(actor(env.reset()))  # the first one checks specs
    with count_syncs() as syncs, torch.no_grad():
        for _ in range(6):
            _, root_E = env.step_and_maybe_reset(actor(root_E))
    assert syncs.total == 0, syncs.report()


def test_a_partial_reset_clears_the_state_of_its_rows_only():
    actor, recurrent = policy()
    env = primed(MaskedTransformedEnv(CounterEnv([9, 9, 9])), recurrent)
    with torch.no_grad():
        _, root_E = env.step_and_maybe_reset(actor(env.reset()))
        before = root_E[recurrent.state_keys[0]].clone()
        root_E = env.reset(env_ids=[1])
    after = root_E[recurrent.state_keys[0]]
    assert (after[1] == 0.0).all() and torch.equal(after[[0, 2]], before[[0, 2]])
    assert root_E["is_init"].flatten().tolist() == [False, True, False]


def test_torchrl_finds_the_primer():
    actor, recurrent = policy()
    primer = get_primers_from_module(actor)
    assert list(primer.primers.keys(True, True)) == recurrent.state_keys


def test_sequences_without_marks_or_time_are_refused():
    actor, recurrent = policy()
    td = rolled_out(primed(MaskedTransformedEnv(CounterEnv([3, 5, 4])), recurrent), actor)
    with set_recurrent_mode(True):
        with pytest.raises(ValueError, match=r"the batch has the dims \(3,\)"):
            actor(td[:, 0].select(*actor.in_keys))
        with pytest.raises(ValueError, match="and no 'is_init'"):
            actor(td.select(*actor.in_keys).exclude("is_init"))
    with pytest.raises(ValueError, match="recurrent_transforms"):
        actor(MaskedTransformedEnv(CounterEnv([3, 5, 4])).reset())


@pytest.mark.parametrize("field", [{"kind": "rnn"}, {"hidden_dim": 0}, {"num_layers": 1.5}])
def test_values_out_of_range_are_refused(field):
    with pytest.raises(ValueError, match=next(iter(field))):
        RecurrentCfg(**field)


# -- actors and critics ------------------------------------------------------------------------------------------------


def test_actor_and_critic_have_recurrent_layers_of_their_own_which_normalize():
    cfg = RecurrentCfg(hidden_dim=H)
    actor = make_recurrent_actor(cfg, ActorCfg(hidden_dims=(8,)), obs_dim=3, action_dim=2)
    critic = make_recurrent_critic(
        cfg, CriticCfg(in_keys=("critic", "actor"), hidden_dims=(8,)), obs_dim=5
    )
    (of_actor,), (of_critic,) = recurrent_modules(actor), recurrent_modules(critic)
    assert not set(of_actor.state_keys) & set(of_critic.state_keys)
    td = TensorDict({"actor": torch.randn(7, 3) + 4.0, "critic": torch.randn(7, 2)}, batch_size=[7])
    for recurrent in (of_actor, of_critic):
        td.update(recurrent.make_tensordict_primer().primers.expand(7).zero())
    td = critic(actor(td))
    assert td["action"].shape == (7, 2) and td["action_log_prob"].shape == (7,)
    assert td["state_value"].shape == (7, 1)
    update_normalizers(td, actor, critic)
    assert of_actor.module.normalizer.count == of_critic.module.normalizer.count == 7
    torch.testing.assert_close(of_actor.module.normalizer.mean, td["actor"].mean(0))
