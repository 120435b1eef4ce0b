"""Policies of each kind are written, read by onnxruntime and by torch, and compared with the actor itself."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, OneHot, Unbounded
from torchrl.modules import ActorValueOperator

from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    DeterministicActorCfg,
    RecurrentCfg,
    SharedTrunkCfg,
    SquashedActorCfg,
    make_actor,
    make_critic,
    make_deterministic_actor,
    make_recurrent_actor,
    make_shared_trunk,
    make_squashed_actor,
)

onnxruntime = pytest.importorskip(
    "onnxruntime", reason="needs the extra: pip install ksim_rl[export]"
)
pytest.importorskip("onnxscript", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl.export import policy as policies  # noqa: E402
from ksim_rl.export.policy import Column, ExportedPolicy  # noqa: E402
from ksim_rl.export.policy_check import CHECKED, greatest_difference  # noqa: E402

PLAIN = {"actor": [Column(name="joint_pos", size=3), Column(name="gyro", size=2)]}
BOUNDED = Bounded(torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 3.0]))
SMALL = {"hidden_dims": (16, 16), "output_gain": 1.0}


def moved(actor: torch.nn.Module) -> torch.nn.Module:
    """Give a new network weights and statistics as if it had learned."""
    draws = torch.Generator().manual_seed(7)
    for parameter in actor.parameters():
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=draws)
    for module in actor.modules():
        if hasattr(module, "count_rows"):
            module.update(3.0 + 2.0 * torch.randn(64, module.dim, generator=draws))
    return actor


def shared_trunk() -> TensorDictSequential:
    trunk = make_shared_trunk(SharedTrunkCfg(hidden_dims=(16,)), obs_dim=5)
    reads = {"in_keys": ("features",), "obs_normalization": False, "hidden_dims": (16,)}
    actor = make_actor(ActorCfg(**reads), obs_dim=16, action_dim=2)
    return ActorValueOperator(
        trunk, actor, make_critic(CriticCfg(**reads), obs_dim=16)
    ).get_policy_operator()


KINDS = {
    "gaussian": lambda: make_actor(ActorCfg(**SMALL), obs_dim=5, action_dim=2),
    "state_dependent": lambda: make_actor(
        ActorCfg(state_dependent_std=True, **SMALL), obs_dim=5, action_dim=2
    ),
    "tanh": lambda: make_actor(
        ActorCfg(distribution="tanh_gaussian", **SMALL), obs_dim=5, action_spec=BOUNDED
    ),
    "truncated": lambda: make_actor(
        ActorCfg(distribution="truncated_gaussian", **SMALL), obs_dim=5, action_spec=BOUNDED
    ),
    "choice": lambda: make_actor(
        ActorCfg(distribution="categorical", **SMALL), obs_dim=5, action_spec=Categorical(4)
    ),
    "one_hot": lambda: make_actor(
        ActorCfg(distribution="categorical", **SMALL), obs_dim=5, action_spec=OneHot(4)
    ),
    "choices": lambda: make_actor(
        ActorCfg(distribution="categorical", **SMALL),
        obs_dim=5,
        action_spec=MultiCategorical((3, 4)),
    ),
    "mixed": lambda: make_actor(
        ActorCfg(**SMALL),
        obs_dim=5,
        action_spec=Composite(aim=Unbounded((2,)), gear=Categorical(3, shape=())),
    ),
    "sac": lambda: make_squashed_actor(SquashedActorCfg(**SMALL), obs_dim=5, action_spec=BOUNDED),
    "td3": lambda: make_deterministic_actor(
        DeterministicActorCfg(**SMALL), obs_dim=5, action_spec=BOUNDED
    ),
    "shared_trunk": shared_trunk,
    "lstm": lambda: make_recurrent_actor(
        RecurrentCfg(hidden_dim=8, num_layers=2), ActorCfg(**SMALL), obs_dim=5, action_dim=2
    ),
    "gru": lambda: make_recurrent_actor(
        RecurrentCfg(kind="gru", hidden_dim=8), ActorCfg(**SMALL), obs_dim=5, action_dim=2
    ),
}


@pytest.mark.parametrize(
    "kind",
    [kind if kind == "tanh" else pytest.param(kind, marks=pytest.mark.full) for kind in KINDS],
)
def test_onnx_equals_the_actor_on_10_000_observations(kind, tmp_path):
    policy = ExportedPolicy(moved(KINDS[kind]()), PLAIN)
    policies.write(policy, tmp_path)
    assert CHECKED == 10_000
    assert greatest_difference(policy, tmp_path / "policy.onnx") < 1e-5


def test_pt2_and_onnx_carry_histories_and_memory_as_inputs_and_outputs(tmp_path):
    columns = {
        "actor": [Column(name="joint_pos", size=2, length=3, stride=2), Column(name="gyro", size=1)]
    }
    recurrent = RecurrentCfg(hidden_dim=4)
    actor = moved(make_recurrent_actor(recurrent, ActorCfg(**SMALL), obs_dim=7, action_dim=2))
    policy = ExportedPolicy(actor, columns)
    policies.write(policy, tmp_path)
    assert greatest_difference(policy, tmp_path / "policy.onnx") < 1e-5
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    named = {value.name: value.shape[1:] for value in session.get_inputs()}
    assert named == {"obs": [3], "history_joint_pos_in": [4, 2], "h_in": [1, 4], "c_in": [1, 4]}
    assert [value.name for value in session.get_outputs()] == policy.output_names

    program = torch.export.load(tmp_path / "policy.pt2").module()
    feeds = [
        np.ones((5, 3), np.float32),
        *(np.full((5, *s.shape), 0.1, np.float32) for s in policy.states),
    ]
    found = program(*map(torch.from_numpy, feeds))
    wanted = session.run(None, dict(zip(policy.input_names, feeds, strict=True)))
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one.detach().numpy(), other, atol=1e-5)


def test_the_files_do_not_name_folders_of_this_machine(tmp_path):
    policies.write(ExportedPolicy(moved(KINDS["gaussian"]()), PLAIN), tmp_path)
    with zipfile.ZipFile(tmp_path / "policy.pt2") as archive:
        parts = [archive.read(name) for name in archive.namelist()]
    here = str(Path(policies.__file__).parent).encode()
    assert not any(here in part for part in (*parts, (tmp_path / "policy.onnx").read_bytes()))


def test_a_wrong_file_is_seen(tmp_path):
    policies.write(ExportedPolicy(moved(KINDS["gaussian"]()), PLAIN), tmp_path)
    other = moved(KINDS["gaussian"]())
    other.module[0].module.normalizer.mean += 0.01
    assert greatest_difference(ExportedPolicy(other, PLAIN), tmp_path / "policy.onnx") > 1e-4


def test_a_policy_of_other_parts_is_refused_by_name():
    class Own(torch.nn.Module):
        pass

    with pytest.raises(ValueError, match="Own"):
        ExportedPolicy(Own(), PLAIN)
