"""Networks of a user's own: the recipe of docs/learning.md as a plug-in, trained, evaluated and exported."""

import json
import sys

import numpy as np
import onnxruntime
import pytest
import torch
from torch import nn
from torchrl.data import Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl import conf, envs
from ksim_rl.algorithms.ppo.wiring import build_networks
from ksim_rl.export import export
from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    QNetworkCfg,
    SquashedActorCfg,
    make_actor,
    make_critic,
    make_q_network,
    make_squashed_actor,
)
from ksim_rl.trainers import load_policy
from tests.cli.test_train import SMALL, run
from tests.docs import guide

NAMED = ("+modules.actor._target_=my_nets.residual.ResidualActorCfg", "++modules.actor.depth=3")


@pytest.fixture(scope="module")
def my_nets(tmp_path_factory):
    """The package of the recipe, importable."""
    folder = tmp_path_factory.mktemp("plugin")
    texts = guide.files("learning.md")
    for path, text in {"my_nets/__init__.py": "", **texts}.items():
        (folder / path).parent.mkdir(exist_ok=True)
        (folder / path).write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setattr(sys, "argv", ["ksim-rl"])
        # Loading a policy remembers the plug-in there, for processes that this one starts.
        patch.setenv("KSIM_RL_PLUGINS", "")
        envs.allow_package("my_nets")
        yield folder


def residual(policy):
    return policy[0].module.trunk


def test_a_config_names_it_and_its_fields(my_nets):
    cfg = conf.compose(["task=cartpole_balance", *NAMED, "modules.actor.init_std=0.5"])
    assert (type(cfg.modules.actor).__name__, cfg.modules.actor.depth) == ("ResidualActorCfg", 3)
    actor, _ = build_networks(cfg, envs.make("cartpole_balance", num_envs=2))
    layers = residual(actor)
    assert [type(layer).__name__ for layer in layers] == [
        "Linear",
        "Residual",
        "Residual",
        "Residual",
    ]
    assert actor[0].module.head.loc.in_features == 32


def test_it_trains_evaluates_and_exports(my_nets, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = [text for text in SMALL if "actor.hidden" not in text]
    folder = tmp_path / "run"
    code = run(
        "train",
        "--plugin",
        "my_nets",
        "task=cartpole_balance",
        "task.sim.engine=c",
        *small,
        *NAMED,
        "trainer.num_iterations=1",
        "trainer.video=false",
        f"hydra.run.dir={folder}",
    )
    assert code == 1
    assert json.loads((folder / "evaluation.json").read_text())["episodes"] == 4
    policy = load_policy(folder, plugins=["my_nets"])
    assert type(residual(policy.actor)[1]).__name__ == "Residual"
    exported = export(folder, tmp_path / "exported")
    session = onnxruntime.InferenceSession(str(exported / "policy.onnx"))
    obs = np.random.default_rng(0).normal(size=(5, 5)).astype(np.float32)
    (actions, *_) = session.run(None, {"obs": obs})
    env_states = envs.make("cartpole_balance", num_envs=5).reset().set("actor", torch.tensor(obs))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = policy.actor(env_states)["action"]
    np.testing.assert_allclose(actions, expected.numpy(), atol=1e-5)


def cfg_that_builds(kind, make):
    """A config of a kind whose `build` is a function."""

    class Own(kind):
        def build(self, input_dim, output_dim, **options):
            return make(input_dim, output_dim)

    return Own(obs_normalization=False)


@pytest.mark.parametrize(
    ("kind", "make", "message"),
    [
        (ActorCfg, lambda i, o: nn.Linear(i + 1, 8), r"cannot map observations \[2, 3\]"),
        (ActorCfg, lambda i, o: nn.GRU(i, 8), "gives a tuple, and no tensor"),
        (ActorCfg, lambda i, o: torch.tanh, "expected a torch.nn.Module"),
        (
            ActorCfg,
            lambda i, o: nn.Flatten(0),
            r"maps \[2, 3\] to \[6\]: expected \[2, number of features\]",
        ),
        (CriticCfg, lambda i, o: nn.Linear(i, 2), r"maps \[2, 3\] to \[2, 2\]: expected \[2, 1\]"),
    ],
)
def test_layers_that_do_not_fit_are_refused(kind, make, message):
    build = make_actor if kind is ActorCfg else make_critic
    options = {"action_dim": 2} if kind is ActorCfg else {}
    with pytest.raises(ValueError, match=f"Own.build.*{message}"):
        build(cfg_that_builds(kind, make), obs_dim=3, **options)


def test_statistics_of_batches_begin_untouched():
    actor = make_actor(
        cfg_that_builds(ActorCfg, lambda i, o: nn.BatchNorm1d(i)), obs_dim=3, action_dim=2
    )
    norm = actor[0].module.trunk
    assert norm.training and int(norm.num_batches_tracked) == 0


def test_critics_and_off_policy_networks_are_built_too():
    critic = make_critic(
        cfg_that_builds(CriticCfg, lambda i, o: nn.Linear(i, o, bias=False)), obs_dim=3
    )
    obs_BL = torch.randn(4, 3)
    torch.testing.assert_close(critic.module(obs_BL), obs_BL @ critic.module.layers.weight.T)
    cfg = cfg_that_builds(QNetworkCfg, nn.Linear)
    assert type(make_q_network(cfg, obs_dim=3, action_dim=2).module.layers) is nn.Linear
    policy = make_squashed_actor(
        cfg_that_builds(SquashedActorCfg, nn.Linear), obs_dim=3, action_spec=Unbounded(2)
    )
    assert type(policy[0].module.layers) is nn.Linear


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "modules.actor._target_=my_nets.residual.ResidualActorCfg",
            r"add it, '\+modules.actor._target_=\.\.\.'",
        ),
        (
            "+modules.actor._target_=my_nets.residual.Residual",
            "Residual is a class, and no dataclass: name the data",
        ),
        (
            "+modules.actor._target_=my_nets.residual.ResidualActor",
            "did you mean 'ResidualActorCfg'",
        ),
        (
            "+modules.critic._target_=my_nets.residual.ResidualActorCfg",
            "expected a kind of CriticCfg",
        ),
    ],
)
def test_wrong_names_get_the_right_hint(my_nets, override, message):
    with pytest.raises(ValueError, match=message):
        conf.compose(["task=cartpole_balance", override])
