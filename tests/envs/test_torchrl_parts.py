"""TorchRL's own parts take our envs as they are: creators, collectors, wrappers, copies, and what comes after."""

import copy
import pickle
import random

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Bounded, Composite
from torchrl.envs import EnvCreator, SerialEnv, TransformedEnv
from torchrl.envs.transforms import (
    ActionDiscretizer,
    ActionScaling,
    DTypeCastTransform,
    MultiAction,
    StepCounter,
    UnsqueezeTransform,
)
from torchrl.envs.utils import check_env_specs

from ksim_rl import envs
from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import ObservationNoise, UniformNoise
from tests.envs.probe_env import puck_cfg, puck_env_in_c


def pucks():
    return MaskedTransformedEnv(
        puck_env_in_c(),
        ObservationNoise(("obs", "position"), noise=UniformNoise(low=-0.1, high=0.1)),
    )


def counters():
    return MaskedTransformedEnv(CounterEnv((3, 4)))


# -- makers and collectors --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [puck_env_in_c, pucks, counters])
@pytest.mark.parametrize("share_memory", [True, False])
def test_env_creators_make_envs(make, share_memory):
    env = EnvCreator(make, share_memory=share_memory)()
    assert env.rollout(3).names == ["E", "T"]


def test_env_creators_fill_serial_envs():
    env = SerialEnv(2, EnvCreator(pucks))
    assert env.rollout(3, break_when_any_done=False).shape == (2, 3, 3)


def test_loading_without_strict_takes_what_fits_and_leaves_the_rest():
    env, other = pucks(), pucks()
    env.rollout(3)
    state = env.state_dict()
    part = {name: value for name, value in state.items() if "world." in name}
    other.load_state_dict(
        {**part, "unknown": torch.ones(1), "base_env.env.unknown": torch.ones(1)}, strict=False
    )
    assert torch.equal(other.world.qpos_EL, env.world.qpos_EL)
    assert other.episode_step_E.sum() == 0 and env.episode_step_E.sum() > 0
    for surplus in ("unknown", "base_env.env.unknown"):
        with pytest.raises((KeyError, ValueError), match="unknown"):
            other.load_state_dict({**state, surplus: torch.ones(1)})
    with pytest.raises(ValueError, match="has no"):
        other.load_state_dict(part)


@pytest.mark.full
def test_several_collectors_stack_envs_with_labels():
    collector = MultiSyncCollector([counters], None, frames_per_batch=8, total_frames=16)
    try:
        batches = [batch.clone() for batch in collector]
    finally:
        collector.shutdown()
    assert [batch.names for batch in batches] == [[None, "E", "time"]] * 2
    assert batches[0].shape == (1, 2, 4)


# -- random actions ---------------------------------------------------------------------------------------------------


def bounded_puck():
    env = puck_env_in_c()
    env.full_action_spec = Composite(action=Bounded(-1.0, 1.0, shape=(3, 1)), shape=(3,))
    return env


CASTS = {
    "cast": (
        lambda: DTypeCastTransform(torch.float32, torch.float64, in_keys_inv=["action"]),
        torch.float64,
        1,
    ),
    "discrete": (lambda: ActionDiscretizer(num_intervals=3), torch.int64, 1),
    "one-hot": (lambda: ActionDiscretizer(num_intervals=3, categorical=False), torch.bool, 3),
    "scaled": (lambda: ActionScaling(), torch.float32, 1),
    "unsqueezed": (lambda: UnsqueezeTransform(-1, in_keys_inv=["action"]), torch.float32, 1),
    "several": (lambda: MultiAction(), torch.float32, 1),
}
WRAPS = {
    "bare": lambda cast: TransformedEnv(bounded_puck(), cast()),
    "around ours": lambda cast: TransformedEnv(MaskedTransformedEnv(bounded_puck()), cast()),
    "in ours": lambda cast: MaskedTransformedEnv(bounded_puck(), cast()),
    "around stock": lambda cast: TransformedEnv(
        TransformedEnv(bounded_puck(), StepCounter()), cast()
    ),
    "appended": lambda cast: TransformedEnv(bounded_puck()).append_transform(cast()),
}


@pytest.mark.parametrize("name", CASTS)
@pytest.mark.parametrize("wrap", WRAPS)
def test_a_stock_env_around_ours_draws_actions_of_its_own_kind(name, wrap):
    make, dtype, width = CASTS[name]
    env = WRAPS[wrap](make)
    action = env.rand_action(env.reset())["action"]
    assert action.dtype == dtype and action.numel() == 3 * width
    assert env.full_action_spec["action"].is_in(action)
    assert env.rollout(3, break_when_any_done=False).shape == (3, 3)


@pytest.mark.parametrize("name", CASTS)
def test_workers_around_a_cast_draw_actions_of_its_own_kind(name):
    make, dtype, width = CASTS[name]
    env = SerialEnv(2, lambda: TransformedEnv(bounded_puck(), make()))
    assert env.rand_action(env.reset())["action"].dtype == dtype
    assert env.rollout(3, break_when_any_done=False).shape == (2, 3, 3)


class OwnActions(CounterEnv):
    """An env that draws its actions in a way of its own."""

    def rand_action(self, tensordict=None):
        return super().rand_action(tensordict).set("mine", torch.ones(self.batch_size))


def test_an_env_with_random_actions_of_its_own_keeps_them():
    env = MaskedTransformedEnv(OwnActions((3, 4)))
    assert "mine" in env.rand_action(env.reset())


# -- copies -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [puck_env_in_c, pucks])
@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_copy_says_how_to_make_a_second_env(make, how):
    with pytest.raises(
        TypeError, match=r"make a second one with ksim_rl\.envs\.build\(env\.cfg"
    ) as raised:
        how(make())
    assert "\n" not in str(raised.value)


def test_a_second_env_made_that_way_goes_on_like_the_first():
    env = envs.build(puck_cfg(limit=None))
    env.rollout(3)
    other = envs.build(env.cfg, device=env.device)
    other.load_state_dict(env.state_dict())
    ends = [
        one.step_and_maybe_reset(one.last_root.clone().set("action", torch.ones(3, 1)))[1]
        for one in (env, other)
    ]
    assert torch.equal(ends[0]["actor"], ends[1]["actor"]) and ends[0]["actor"].any()


def test_copies_of_other_envs_share_nothing():
    env = counters()
    other = copy.copy(env)
    env.rollout(2)
    assert other.last_root is None and other.base_env is not env.base_env


# -- the end ----------------------------------------------------------------------------------------------------------

CALLS = {
    "reset": lambda env: env.reset(),
    "rollout": lambda env: env.rollout(2),
    "rand_step": lambda env: env.rand_step(),
    "seed": lambda env: env.seed(3),
    "set_seed": lambda env: env.set_seed(3),
    "state_dict": lambda env: env.state_dict(),
    "load_state_dict": lambda env: env.load_state_dict({}, strict=False),
    "render": lambda env: env.render(),
    "explain": lambda env: env.explain(),
    "episode_log": lambda env: env.episode_log(),
    "curriculum_levels": lambda env: env.curriculum_levels(),
    "stagger_episodes_": lambda env: env.stagger_episodes_(),
    "step_dt": lambda env: env.step_dt,
    "episode_step_E": lambda env: env.episode_step_E,
}


@pytest.fixture(scope="module")
def closed():
    """Return an env that a collector has closed, with the last batch."""
    env = pucks()
    collector = Collector(env, None, frames_per_batch=6, total_frames=6)
    batches = list(collector)
    collector.shutdown()
    assert env.is_closed
    return env, batches[-1]


@pytest.mark.parametrize("call", CALLS)
def test_a_closed_env_says_so(closed, call):
    for env in (closed[0], closed[0].base_env):
        with pytest.raises(RuntimeError, match="the env is closed, .* make another one"):
            CALLS[call](env)


def test_a_step_of_a_closed_env_says_so(closed):
    env, batch = closed
    with pytest.raises(RuntimeError, match="the env is closed"):
        env.step(batch[:, 0])
    with pytest.raises(RuntimeError, match="the env is closed"):
        env.step_and_maybe_reset(batch[:, 0])
    assert env.num_envs == 3 and env.cfg.decimation == 4 and "ManagerBasedRlEnv" in repr(env)
    env.close(raise_if_closed=False)


# -- the class --------------------------------------------------------------------------------------------------------


def test_the_class_has_the_metadata():
    assert ManagerBasedRlEnv.metadata["render_modes"] == [None, "rgb_array"]
    assert ManagerBasedRlEnv.metadata is puck_env_in_c().metadata


def test_seed_on_the_class_seeds_the_process():
    def draws():
        return random.random(), float(np.random.rand()), float(torch.rand(()))

    assert ManagerBasedRlEnv.seed(5) == 5
    first = draws()
    assert ManagerBasedRlEnv.seed(seed=5) == 5
    assert draws() == first
    drawn = ManagerBasedRlEnv.seed()
    assert 0 <= drawn < 2**31 and draws() != first


def test_an_env_without_terms_glides():
    cfg = puck_cfg()
    env = ManagerBasedRlEnv(ManagerBasedRlEnvCfg(decimation=2, scene=cfg.scene))
    assert env.full_action_spec["action"].shape == (3, 0)
    check_env_specs(env)
    assert env.rollout(3).shape == (3, 3)
    assert envs.build(ManagerBasedRlEnvCfg(decimation=2, scene=cfg.scene)).rollout(3).shape == (
        3,
        3,
    )
