"""`RolloutCollector` against TorchRL's own rollout and collector."""

import dataclasses
from contextlib import contextmanager

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, exploration_type

from ksim_rl import envs
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.mdp import JointPos, JointVel
from ksim_rl.testing import count_syncs
from ksim_rl.transforms import UniformNoise
from tests.envs.probe_env import DT, RandomLaunch, Target, puck_cfg

STEPS = 12


def noisy_env(seed=5):
    """A puck with noise, commands, random starts, and episodes that end at different times."""
    terms = {
        "position": envs.ObservationTermCfg(
            term=JointPos(), noise=UniformNoise(low=-0.1, high=0.1)
        ),
        "velocity": envs.ObservationTermCfg(term=JointVel(), history=3),
    }
    groups = {
        "actor": envs.ObservationGroupCfg(terms=terms),
        "critic": envs.ObservationGroupCfg(terms=terms),
    }
    cfg = puck_cfg(
        events={"launch": RandomLaunch()},
        limit=0.05,
        episode_length_s=7 * DT,
        commands={"target": Target(resampling_time_range_s=(DT, 3 * DT))},
        seed=seed,
        num_envs=4,
    )
    return envs.build(dataclasses.replace(cfg, observations=groups))


class RandomPolicy(torch.nn.Module):
    """Draws actions from torch's default generator, and leaves a trace of what it saw."""

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        noise = torch.randn(*td.batch_size, 1)
        td.set("action", 0.1 * noise + 0.01 * td["actor"][..., :1])
        return td.set("action_log_prob", noise[..., 0].square())


class SteadyPolicy(RandomPolicy):
    """Notes of each call how many `steady` have begun, or None outside of them."""

    def __init__(self):
        super().__init__()
        self.begun, self.within, self.calls = 0, False, []

    @contextmanager
    def steady(self):
        self.begun, self.within = self.begun + 1, True
        yield
        self.within = False

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        self.calls.append(self.begun if self.within else None)
        return super().forward(td)


def assert_same(actual: TensorDictBase, expected: TensorDictBase, ignore=()):
    keys = {
        key
        for key in expected.keys(True, True)
        if (key if isinstance(key, str) else key[0]) not in ignore
    }
    assert keys <= set(actual.keys(True, True))
    for key in keys:
        assert torch.equal(actual[key], expected[key]), key
    assert expected["next", "done"].any(), "the comparison must include resets"


def collected(seed=0):
    torch.manual_seed(seed)
    collector = RolloutCollector(noisy_env(), RandomPolicy(), rollout_length=STEPS)
    first = collector.collect().clone()
    return first, collector.collect().clone()


def test_equals_env_rollout_resets_included():
    first, second = collected()
    env = noisy_env()
    torch.manual_seed(0)
    root_E = env.reset()
    expected = env.rollout(
        2 * STEPS, RandomPolicy(), auto_reset=False, tensordict=root_E, break_when_any_done=False
    )
    assert_same(first, expected[:, :STEPS])
    assert_same(second, expected[:, STEPS:])


def test_equals_the_stock_collector():
    first, second = collected()
    torch.manual_seed(0)
    env = noisy_env()
    stock = Collector(env, RandomPolicy(), frames_per_batch=4 * STEPS, total_frames=8 * STEPS)
    torch.manual_seed(0)
    batches = [batch.clone() for batch in stock]
    stock.shutdown(close_env=False)
    assert_same(first, batches[0], ignore=("collector",))
    assert_same(second, batches[1], ignore=("collector",))


def test_a_policy_is_steady_once_for_all_steps_of_a_rollout():
    policy = SteadyPolicy()
    collector = RolloutCollector(
        noisy_env(), policy, rollout_length=STEPS, cfg=CollectorCfg(compile=False)
    )
    collector.collect()
    collector.collect()
    assert policy.calls == [1] * STEPS + [2] * STEPS


class ModePolicy(RandomPolicy):
    """Acts by how it is asked to: 1 where actions are drawn, 0 where they are deterministic."""

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        drawn = exploration_type() == ExplorationType.RANDOM
        return td.set("action", torch.full_like(super().forward(td)["action"], float(drawn)))


@pytest.mark.parametrize("explores", [True, False])
def test_a_policy_explores_unless_it_is_asked_not_to(explores):
    collector = RolloutCollector(noisy_env(), ModePolicy(), rollout_length=2, explores=explores)
    assert (collector.collect()["action"] == float(explores)).all()


def test_dims_are_named_and_memory_is_reused():
    collector = RolloutCollector(noisy_env(), RandomPolicy(), rollout_length=3)
    rollout_ET = collector.collect()
    assert rollout_ET.names == ["E", "T"] and rollout_ET["next"].names == ["E", "T"]
    address = rollout_ET["next", "reward"].data_ptr()
    assert collector.collect()["next", "reward"].data_ptr() == address


def test_keys_choose_what_is_stored():
    keys = ["actor", "action", ("next", "reward")]
    rollout_ET = RolloutCollector(
        noisy_env(), RandomPolicy(), rollout_length=2, keys=keys
    ).collect()
    assert set(rollout_ET.keys(True, True)) == set(keys)


def test_an_unknown_key_is_refused():
    with pytest.raises(ValueError, match="no step produces 'actro'"):
        RolloutCollector(noisy_env(), RandomPolicy(), rollout_length=2, keys=["actro"]).collect()


def test_a_rollout_needs_a_length():
    with pytest.raises(ValueError, match="rollout_length=0"):
        RolloutCollector(noisy_env(), RandomPolicy(), rollout_length=0)


@pytest.mark.parametrize(
    ("field", "value"),
    [("warmup", 0), ("warmup", True), ("require_graphs", "no"), ("stagger_episodes", 1)],
)
def test_options_of_another_kind_are_refused(field, value):
    with pytest.raises(ValueError, match=f"{field}={value!r}: expected"):
        CollectorCfg(**{field: value})


def test_a_rollout_never_makes_the_host_wait():
    collector = RolloutCollector(noisy_env(), RandomPolicy(), rollout_length=STEPS)
    for _ in range(3):
        collector.collect()
    # The fourth is not one of those before which the recorded step is compared with the env's own.
    with count_syncs() as syncs:
        collector.collect()
    assert syncs.total == 0, syncs.report()


def test_state_dict_continues_bit_exactly():
    env, other = noisy_env(), noisy_env(seed=6)
    collector = RolloutCollector(env, RandomPolicy(), rollout_length=4)
    twin = RolloutCollector(other, RandomPolicy(), rollout_length=4)
    collector.collect()
    twin.reset()
    other.load_state_dict(env.state_dict())
    twin.load_state_dict(collector.state_dict())
    torch.manual_seed(1)
    expected = collector.collect().clone()
    torch.manual_seed(1)
    actual = twin.collect()
    assert all(torch.equal(actual[key], expected[key]) for key in expected.keys(True, True))


def test_a_state_of_other_shapes_or_names_is_refused():
    collector = RolloutCollector(noisy_env(), RandomPolicy(), rollout_length=2)
    collector.reset()
    state = collector.state_dict()
    with pytest.raises(
        ValueError,
        match=r"same num_envs.*'actor' is float32\[1, .*in the checkpoint and float32\[4, ",
    ):
        collector.load_state_dict(state | {"actor": state["actor"][:1] + 1.0})
    with pytest.raises(ValueError, match="'other' is unknown"):
        collector.load_state_dict(state | {"other": state["actor"]})
    assert torch.equal(collector.state_dict()["actor"], state["actor"])
