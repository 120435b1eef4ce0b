"""TorchRL's own parts on our tasks, untouched."""

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, RewardSum, StepCounter
from torchrl.envs.utils import check_env_specs

from ksim_rl import dims, envs
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.modules import ActorCfg, make_actor
from ksim_rl.scene.scene import build_spec
from ksim_rl.testing import check_env, count_syncs
from tests.absent_models import skipped_without_models

E, T = 4, 16
EPISODE_STEPS = 6  # short, so that each rollout holds several resets
# One of each kind; every registered task is checked in tests/tasks.
TASKS = (
    "cartpole_balance",
    pytest.param("go1_velocity_flat", marks=pytest.mark.full),
    # tests/scene/terrains has an env on rough ground.
    pytest.param("go1_velocity_rough", marks=pytest.mark.full),
    "quadruped_velocity_flat",
    pytest.param("arm_push", marks=pytest.mark.full),
)


def made(task: str) -> envs.MaskedTransformedEnv:
    """Build a task with short episodes, or skip if its robot is not at hand."""
    cfg = envs.make_cfg(task)
    timestep = cfg.sim.timestep or build_spec(cfg.scene).option.timestep
    step_s = cfg.decimation * timestep
    with skipped_without_models():
        return envs.make(
            task, num_envs=E, seed=3, overrides=[f"task.episode_length_s={EPISODE_STEPS * step_s}"]
        )


@pytest.fixture(scope="module", params=TASKS)
def env(request):
    env = made(request.param)
    yield env
    env.close()


def actions_of(env, steps=T):
    generator = torch.Generator().manual_seed(1)
    return torch.rand((steps, *env.action_spec.shape), generator=generator) * 2.0 - 1.0


def rolled_out(env, actions) -> TensorDictBase:
    """Roll out from the seed with given actions, through the ends of episodes."""
    env.set_seed(7)
    steps = iter(actions)
    return env.rollout(
        len(actions), lambda td: td.set("action", next(steps)), break_when_any_done=False
    )


def assert_same(actual: TensorDictBase, expected: TensorDictBase) -> None:
    keys = set(expected.keys(True, True))
    assert keys <= set(actual.keys(True, True))
    for key in keys:
        assert torch.equal(actual[key], expected[key]), key
    assert int(expected["next", "done"].sum()) >= E, "the comparison must include resets"


def test_stock_and_own_checks_pass(env):
    check_env_specs(env)
    check_env(env)
    check_env_specs(env.base_env)
    check_env(env.base_env)


def test_no_step_or_reset_makes_the_host_wait(env):
    actions = list(actions_of(env))
    root_E = env.reset()
    mask_E = torch.arange(E) % 2 == 0
    with count_syncs() as syncs:
        env.reset()
        for action_EL in actions:
            _, root_E = env.step_and_maybe_reset(root_E.set("action", action_EL))
        env.reset(root_E.empty().set("_reset", mask_E))
        steps = iter(actions)
        env.rollout(T, lambda td: td.set("action", next(steps)), break_when_any_done=False)
    assert syncs.total == 0, syncs.report()


def test_stock_transforms_around_the_bare_env_give_right_sums(env):
    actions = actions_of(env)
    stock = TransformedEnv(env.base_env, Compose(RewardSum(), StepCounter()))
    check_env_specs(stock)
    rollout_ET = rolled_out(stock, actions)
    check_sums(rollout_ET)
    own = rolled_out(env.base_env, actions)
    assert_same(rollout_ET, own)


def test_stock_transforms_around_the_made_env_give_right_sums(env):
    actions = actions_of(env)
    stock = TransformedEnv(env, Compose(RewardSum(), StepCounter()))
    check_env_specs(stock)
    rollout_ET = rolled_out(stock, actions)
    check_sums(rollout_ET)
    assert_same(rollout_ET, rolled_out(env, actions))


def check_sums(rollout_ET: TensorDictBase) -> None:
    """Compare `episode_reward` and `step_count` with sums that start over after each end."""
    total_E1, count_E1 = torch.zeros(E, 1), torch.zeros(E, 1, dtype=torch.int64)
    next_ET = rollout_ET["next"]
    for t in range(T):
        assert torch.equal(rollout_ET["step_count"][:, t], count_E1)
        total_E1, count_E1 = total_E1 + next_ET["reward"][:, t], count_E1 + 1
        torch.testing.assert_close(next_ET["episode_reward"][:, t], total_E1)
        assert torch.equal(next_ET["step_count"][:, t], count_E1)
        done_E1 = next_ET["done"][:, t]
        total_E1, count_E1 = total_E1.masked_fill(done_E1, 0.0), count_E1.masked_fill(done_E1, 0)


def test_an_eager_rollout_is_continuous_and_ends_by_time(env):
    rollout_ET = rolled_out(env, actions_of(env))
    assert rollout_ET.names == [dims.E, dims.T] and rollout_ET.shape == (E, T)
    assert rollout_ET["next", "truncated"].any()
    goes_on = ~rollout_ET["next", "done"][:, :-1, 0]
    for key in env.full_observation_spec.keys(True, True):
        root, reached = rollout_ET[key][:, 1:], rollout_ET["next"][key][:, :-1]
        assert torch.equal(root[goes_on], reached[goes_on]), key
    assert env.base_env.max_episode_length == EPISODE_STEPS
    assert env.rollout(T, break_when_any_done=True)["next", "done"][:, -1].any()


def make_policy(env):
    torch.manual_seed(0)
    cfg = ActorCfg(hidden_dims=(16,), init_std=0.5)
    return make_actor(
        cfg, obs_dim=env.observation_spec["actor"].shape[-1], action_dim=env.action_spec.shape[-1]
    )


def test_the_stock_collector_with_our_actor_equals_our_collector(env):
    policy = make_policy(env)
    env.set_seed(7)
    torch.manual_seed(1)
    own = RolloutCollector(env, policy, rollout_length=T, cfg=CollectorCfg(compile=False))
    expected = own.collect().clone()
    env.set_seed(7)
    # A stock collector that has reached its total closes its env.
    collector = Collector(
        env,
        policy,
        frames_per_batch=E * T,
        total_frames=2 * E * T,
        auto_register_policy_transforms=False,
    )
    torch.manual_seed(1)
    batch = next(iter(collector)).clone()
    collector.shutdown(close_env=False)
    assert_same(batch, expected)
    assert dims.name(batch, dims.E, dims.T).names == [dims.E, dims.T]
    assert batch["action_log_prob"].isfinite().all()
