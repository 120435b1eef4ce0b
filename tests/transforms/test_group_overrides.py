"""Noise, delay, history and the level are reachable from the command line, and survive the way through YAML."""

import pytest

from ksim_rl.config.config_tree import from_tree, to_tree
from ksim_rl.envs import make_cfg
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.transforms import (
    DelayCfg,
    GaussianNoise,
    HistoryCfg,
    ObservationDelay,
    ObservationHistory,
    ObservationNoise,
    UniformNoise,
)
from ksim_rl.transforms.groups.group_cfg import compile_groups

NOISE = "ksim_rl.transforms.noise.cfg"


@pytest.fixture(scope="module")
def actor():
    group = "task.observations.actor"
    first = next(iter(make_cfg("cartpole_swingup").observations["actor"].terms))
    term = f"{group}.terms.{first}"
    cfg = make_cfg(
        "cartpole_swingup",
        [
            f"{term}.noise={{_target_: {NOISE}.GaussianNoise, std: 0.5, walk_std: 0.01, by_level: true,"
            f" bias: {{_target_: {NOISE}.UniformNoise, low: -1, high: 1}}}}",
            f"{term}.delay={{min_lag: 1, max_lag: 3, resample_every: 10, hold_probability: 0.5}}",
            f"{group}.delay={{max_lag: 2, by_level: true}}",
            f"{group}.history={{length: 5, stride: 2}}",
        ],
    )
    assert from_tree(ManagerBasedRlEnvCfg, to_tree(cfg, ManagerBasedRlEnvCfg)) == cfg
    return cfg.observations["actor"], first


def test_overrides_become_configs(actor):
    group, first = actor
    noise = GaussianNoise(
        std=0.5, walk_std=0.01, by_level=True, bias=UniformNoise(low=-1.0, high=1.0)
    )
    assert group.terms[first].noise == noise
    assert group.terms[first].delay == DelayCfg(
        min_lag=1, max_lag=3, resample_every=10, hold_probability=0.5
    )
    assert group.delay == DelayCfg(max_lag=2, by_level=True)
    assert group.history == HistoryCfg(length=5, stride=2)


def test_configs_become_transforms(actor):
    group, first = actor
    transforms = compile_groups({"actor": group})
    kinds = {kind: [t for t in transforms if type(t) is kind] for kind in map(type, transforms)}
    assert [t.in_keys for t in kinds[ObservationNoise]] == [[("obs", first)]]
    own, shared = kinds[ObservationDelay]
    assert own.delay.max_lag == 3 and own.in_keys == [("actor_terms", first)]
    assert shared.delay.max_lag == 2 and len(shared.in_keys) == len(group.terms) - 1
    (history,) = kinds[ObservationHistory]
    assert (history.length, history.stride, len(history.in_keys)) == (5, 2, len(group.terms))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("delay={max_lag: -1}", "task.observations.actor.delay.max_lag=-1"),
        ("history={length: 0}", "task.observations.actor.history.length=0"),
        ("history={length: 2, strid: 3}", "strid.*did you mean 'stride'"),
    ],
)
def test_wrong_overrides_are_refused_with_their_path(override, message):
    with pytest.raises(ValueError, match=message):
        make_cfg("cartpole_swingup", [f"task.observations.actor.{override}"])
