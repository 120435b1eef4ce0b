"""What only a GPU can show: no host sync, and graphs that do what eager code does."""

import pytest
import torch

from ksim_rl import conf, envs
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.trainers import build
from tests.absent_models import skipped_without_models

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

TASKS = ("cartpole_balance", "cartpole_swingup", "go1_velocity_flat")


def make(name, **kwargs):
    with skipped_without_models():
        return envs.make(name, num_envs=64, device="cuda", seed=1, **kwargs)


@pytest.fixture
def no_syncs():
    """Make each host sync an error inside the block that the test opens."""

    class Mode:
        def __enter__(self):
            torch.cuda.synchronize()
            torch.cuda.set_sync_debug_mode("error")

        def __exit__(self, *_):
            torch.cuda.set_sync_debug_mode("default")

    return Mode()


def random_policy(td):
    return td.set(
        "action", 0.3 * torch.randn(td["actor"].shape[0], random_policy.size, device="cuda")
    )


@pytest.mark.parametrize("name", TASKS)
def test_step_and_reset_make_no_host_sync(name, no_syncs):
    env = make(name)
    random_policy.size = env.action_spec.shape[-1]
    root_E = env.reset()
    for _ in range(3):
        _, root_E = env.step_and_maybe_reset(random_policy(root_E))
    with no_syncs:
        for _ in range(5):
            _, root_E = env.step_and_maybe_reset(random_policy(root_E))
        env.reset()


def rollouts(name, *, captured, count=3, compile=False):
    """Collect rollouts with a random policy: one eager, then captured ones, or all of them eager."""
    env = make(name)
    random_policy.size = env.action_spec.shape[-1]
    cfg = CollectorCfg(warmup=1 if captured else count, compile=compile)
    collector = RolloutCollector(env, random_policy, rollout_length=8, cfg=cfg)
    torch.manual_seed(0)
    found = [collector.collect().clone() for _ in range(count)]
    assert (collector.compiled_step is not None) == compile
    return found


@pytest.mark.parametrize("name", ("cartpole_balance", "cartpole_swingup"))
def test_captured_rollouts_equal_eager_ones(name):
    for actual, expected in zip(
        rollouts(name, captured=True), rollouts(name, captured=False), strict=True
    ):
        for key in expected.keys(True, True):
            torch.testing.assert_close(
                actual[key], expected[key], rtol=1e-5, atol=1e-5, msg=str(key)
            )


@pytest.mark.parametrize("name", TASKS)
def test_compiled_rollouts_in_a_graph_are_those_of_the_env(name):
    pairs = zip(
        rollouts(name, captured=True, compile=True), rollouts(name, captured=False), strict=True
    )
    for actual, expected in pairs:
        for key in expected.keys(True, True):
            # Rounding grows where feet touch the ground, and decides now and then what becomes of an episode.
            error = (actual[key].float() - expected[key].float()).abs()
            assert (error <= 1e-3 * (1.0 + expected[key].float().abs())).float().mean() > 0.97, key


def test_captured_rollouts_in_contact_differ_from_eager_ones_no_more_than_eager_ones_do():
    # Atomic adds make the physics of contacts differ from run to run; a wrong capture would differ far more.
    name = "go1_velocity_flat"
    first, second = rollouts(name, captured=False), rollouts(name, captured=False)
    for actual, expected, again in zip(rollouts(name, captured=True), first, second, strict=True):
        for key in (
            ("obs", "joint_pos"),
            ("obs", "joint_vel"),
            ("obs", "base_lin_vel"),
            ("next", "reward"),
        ):
            error = (actual[key] - expected[key]).abs().quantile(0.9)
            noise = (again[key] - expected[key]).abs().quantile(0.9)
            assert error <= 10.0 * noise + 1e-4, f"{key}: {error} against {noise}"


def test_whole_iterations_make_no_host_sync_and_learn(no_syncs):
    cfg = conf.compose(
        [
            "task=cartpole_balance",
            "num_envs=256",
            "device=cuda",
            "data.num_env_states_per_minibatch=1024",
            "data.num_minibatches=4",
            "logger=none",
            "trainer.eval_episodes=0",
        ]
    )
    trainer = build(cfg)
    before = [p.detach().clone() for p in trainer.update.actor.parameters()]
    for _ in range(4):
        trainer.update(trainer.collector.collect())
    with no_syncs:
        for _ in range(5):
            trainer.update(trainer.collector.collect())
    assert trainer.collector._run.ready and trainer.update._run.ready
    after = list(trainer.update.actor.parameters())
    assert all(torch.isfinite(p).all() for p in after)
    assert any(not torch.equal(a, b) for a, b in zip(after, before, strict=True))


def test_a_failed_world_is_reset_inside_the_graph():
    env = make("cartpole_balance")
    random_policy.size = 1
    collector = RolloutCollector(env, random_policy, rollout_length=4)
    for _ in range(4):
        collector.collect()
    env.base_env.episode_log_reset_()
    env.base_env.world.qvel_EL[3] = torch.nan
    rollout_ET = collector.collect()
    assert (
        rollout_ET["next", "terminated"][3, 0] and not rollout_ET["next", "terminated"][:3, 0].any()
    )
    assert all(torch.isfinite(leaf).all() for leaf in rollout_ET.values(True, True))
    assert env.base_env.episode_log()["termination/non_finite"] == 1
