"""A compiled step does what the env does, to rounding, whatever it is made of; one that does not is not used."""

import itertools

import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.collectors import CollectorCfg, RolloutCollector, compiled_step
from ksim_rl.collectors.compiled_step import CompiledStep
from ksim_rl.envs.term import RewardTerm
from tests.absent_models import skipped_without_models
from tests.envs.probe_env import puck_cfg
from tests.trainers.target_env import TargetEnv

QUICK = ("cartpole_swingup", "pendulum_swingup")
TASKS = (
    "arm_push", "cheetah_run", "reacher", "walker_track", "walker_amp", "quadruped_velocity_delayed",
    "quadruped_get_up", "humanoid_velocity_flat", "humanoid_get_up", "playground_finger_spin", "dm_control_fish_swim",
)  # fmt: skip
MENAGERIE = ("go1_velocity_flat", "g1_velocity_flat", "go2_velocity_flat", "go1_velocity_rough")
ROWS, STEPS = 33, 12


def policy(env):
    size = env.full_action_spec["action"].shape[-1]
    return lambda td: td.set("action", torch.randn(*td.batch_size, size))


def rollouts(task, *, compile, count=2, **overrides):
    env = envs.make(task, num_envs=ROWS, seed=3, device="cpu", **overrides)
    torch.manual_seed(0)
    collector = RolloutCollector(
        env, policy(env), rollout_length=STEPS, cfg=CollectorCfg(compile=compile)
    )
    return [collector.collect().clone() for _ in range(count)], env.state_dict()


def check(task, **overrides):
    (expected, state), (found, own_state) = (
        rollouts(task, compile=compile, **overrides) for compile in (False, True)
    )
    for own, true in zip(found, expected, strict=True):
        for key in true.keys(True, True):
            torch.testing.assert_close(
                own[key],
                true[key],
                rtol=1e-3,
                atol=2e-3,
                msg=lambda text, key=key: f"{key}: {text}",
            )
    assert own_state.keys() == state.keys()
    return expected


@pytest.mark.parametrize("task", QUICK)
def test_rollouts_are_those_of_the_env_resets_included(task):
    expected = check(task, overrides=["task.episode_length_s=0.1"])
    assert torch.cat([rollout["next", "done"] for rollout in expected]).any()


@pytest.mark.full
@pytest.mark.parametrize("task", [*TASKS, *MENAGERIE])
def test_rollouts_of_every_kind_of_task_are_those_of_the_env(task):
    with skipped_without_models():
        check(task)


def made(task="cartpole_swingup"):
    env = envs.make(task, num_envs=ROWS, seed=3, device="cpu")
    root_E = env.reset().clone()
    return env, root_E, policy(env)(root_E.copy())


def test_making_one_leaves_env_and_root_as_they_were():
    env, root_E, tensordict = made()
    before, root_before_E = env.state_dict(), root_E.clone()
    CompiledStep(env, root_E, tensordict)
    for name, value in env.state_dict().items():
        assert not isinstance(value, torch.Tensor) or torch.equal(value, before[name]), name
    assert (root_E == root_before_E).all()


def test_it_is_few_kernels():
    env, root_E, tensordict = made()
    step = CompiledStep(env, root_E, tensordict)
    assert len(step._tape.parts) < 20


def test_a_step_that_gives_something_else_is_not_used(monkeypatch):
    env, root_E, tensordict = made()
    monkeypatch.setattr(compiled_step.Tape, "__call__", lambda tape: None)
    with pytest.raises(RuntimeError, match="another .* in 33 rows.* than the env"):
        CompiledStep(env, root_E, tensordict)
    collector = RolloutCollector(env, policy(env), rollout_length=2, cfg=CollectorCfg(compile=True))
    with pytest.warns(RuntimeWarning, match="NOT COMPILED"):
        collector.collect()
    collector.collect()


def give_otherwise(monkeypatch, change):
    """Let `change` have the results of each compiled step, as if its kernels were wrong."""
    run = CompiledStep._run

    def changed(step):
        next_E = run(step)
        change(next_E["next"])
        return next_E

    monkeypatch.setattr(CompiledStep, "_run", changed)


def test_a_number_in_one_row_is_enough(monkeypatch):
    def change(next_E):
        next_E["obs", "position"][5, 1] *= 1.0 + 3e-4

    give_otherwise(monkeypatch, change)
    with pytest.raises(RuntimeError, match=r"another next\.obs\.position in 1 rows than the env"):
        CompiledStep(*made())


def test_rows_that_end_are_compared_as_well(monkeypatch):
    def change(next_E):
        next_E["obs", "position"][next_E["done"][:, 0]] += 1.0

    give_otherwise(monkeypatch, change)
    CompiledStep(*made())
    with pytest.raises(RuntimeError, match=r"another next\.obs\.position in 5 rows than the env"):
        CompiledStep(*made(), nan_ends_rows=True)


class Sensitive(RewardTerm):
    """Of the first row no more than the last places of its position, of the others the position, m."""

    def __call__(self, view):
        position_E = view.joint_pos_EL[:, 0]
        row_E = torch.arange(view.num_envs, device=view.device)
        return torch.where(row_E == 0, torch.sin(1e7 * position_E), position_E)


@pytest.mark.parametrize(("row", "is_used"), [(0, True), (1, False)])
def test_a_row_may_differ_as_much_as_rounding_can_change_it(row, is_used, monkeypatch):
    def change(next_E):
        next_E["reward"][row] += 1e-3

    give_otherwise(monkeypatch, change)
    env = envs.build(puck_cfg(num_envs=4, rewards={"sensitive": Sensitive()}, limit=None))
    root_E = env.step_and_maybe_reset(env.rand_action(env.reset()))[1].clone()
    given = root_E, env.rand_action(root_E.copy())
    if is_used:
        CompiledStep(env, *given)
        return
    with pytest.raises(RuntimeError, match=r"another next\.reward in 1 rows than the env"):
        CompiledStep(env, *given)


@pytest.mark.parametrize("read", [torch.Tensor.numpy, torch.Tensor.tolist, np.asarray])
def test_numbers_that_python_takes_out_of_a_tensor_are_refused(read):
    env, root_E, tensordict = made()
    step = env.step_and_maybe_reset

    def reading(td):
        read(td["action"])
        return step(td)

    env.__dict__["step_and_maybe_reset"] = reading
    with pytest.raises(RuntimeError, match=r"on the host, at test_compiled_step\.py:\d+"):
        CompiledStep(env, root_E, tensordict)


def test_a_term_that_reads_the_device_on_the_host_is_named():
    env, root_E, tensordict = made()
    step = env.step_and_maybe_reset

    def reading(td):
        td["action"].sum().item()
        return step(td)

    env.__dict__["step_and_maybe_reset"] = reading
    with pytest.raises(RuntimeError, match="on the host"):
        CompiledStep(env, root_E, tensordict)


def test_what_a_step_keeps_elsewhere_than_in_tensors_shows_in_the_second():
    env, root_E, tensordict = made()
    step, steps = env.step_and_maybe_reset, itertools.count()

    def weakening(td):
        return step(td.set("action", td["action"] * (1.0 if next(steps) < 2 else 0.5)))

    env.__dict__["step_and_maybe_reset"] = weakening
    with pytest.raises(RuntimeError, match="another .* than the env"):
        CompiledStep(env, root_E, tensordict)


def test_steps_of_envs_with_a_world_are_compiled_unless_a_config_says_otherwise():
    env = envs.make("cartpole_swingup", num_envs=ROWS, device="cpu")
    foreign = TargetEnv(num_envs=ROWS)
    for own, cfg, is_compiled in (
        (env, CollectorCfg(), True),
        (env, CollectorCfg(compile=False), False),
        (foreign, CollectorCfg(), False),
    ):
        collector = RolloutCollector(own, policy(own), rollout_length=1, cfg=cfg)
        collector.warm_up()
        assert (collector.compiled_step is not None) == is_compiled
