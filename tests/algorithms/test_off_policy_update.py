"""The update of off-policy learning: what it learns on probes with known values, and what it refuses."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ksim_rl.data import OfflineCfg, ReplayCfg
from ksim_rl.objectives import NonFiniteStepsError, SACCfg
from ksim_rl.testing import count_syncs
from ksim_rl.trainers.restoring import load_networks
from tests.algorithms.off_policy_problem import (
    GAMMA,
    OBJECTIVES,
    clone_for,
    make_trainer,
    recorded_table,
)
from tests.trainers.target_env import BEST_RETURN, make_env

NAMES = list(OBJECTIVES)


@pytest.mark.parametrize(
    ("name", "ends"),
    [
        pytest.param("sac", "truncation", marks=pytest.mark.full),
        ("td3", "termination"),
        pytest.param("fast_sac", "termination", marks=pytest.mark.full),
        pytest.param("fast_td3", "truncation", marks=pytest.mark.full),
    ],
)
def test_finds_the_best_actions_and_their_values(name, ends):
    env = make_env(32, terminate_at=1 if ends == "termination" else None)
    trainer = make_trainer(name, iterations=70, env=env, data={"n_step": 2})
    for _ in range(70):
        trainer.iterate()
    outcome = trainer.evaluator()
    assert outcome.return_mean > 0.95 * BEST_RETURN
    # The best action earns 1 per step, for ever where episodes are cut off by the clock only, and once where each
    # step ends one. A value bootstrapped from the next episode's first observation would be 10 in both.
    best = 1.0 if ends == "termination" else 1.0 / (1.0 - GAMMA)
    update = trainer.update
    with torch.no_grad():
        obs = torch.linspace(-1.0, 1.0, 9)[:, None]
        prediction = update.critic.module(obs, obs)
        if update.loss.support_A is not None:
            prediction = prediction.softmax(-1) @ update.loss.support_A
    assert (prediction - best).abs().max() < 0.1 * best + 0.05, prediction


@pytest.mark.parametrize("name", ["sac", "fast_td3"])
def test_random_actions_until_learning_starts(name):
    trainer = make_trainer(name)
    update = trainer.update
    before = [parameter.clone() for parameter in update.actor.parameters()]
    for number in range(3):
        rollout = trainer.collector.collect()
        spread = rollout["action"].std()
        # Uniform actions in [-2, 2] have a std of 1.15; the first policy acts around zero.
        assert (spread > 1.0) == (number < 2)
        update(rollout)
        same = all(
            torch.equal(a, b) for a, b in zip(before, update.actor.parameters(), strict=True)
        )
        assert same == (number == 0)
    assert update.metrics()["replay/env_states"] == 3 * 4 * 32


def test_a_loaded_policy_acts_from_the_first_step_and_waits_for_its_critics(tmp_path):
    """The critics begin to learn at step 8, and the policy at step 16."""
    trainer = make_trainer("fast_sac", data={"policy_starts": 16})
    update = trainer.update
    said = load_networks(update, clone_for("fast_sac", num_updates=0), tmp_path)
    assert "the critic starts from scratch; with data.policy_starts" in said
    networks = (update.actor, update.critic)
    first = [[own.clone() for own in network.parameters()] for network in networks]
    found = []
    for _ in range(4):
        rollout = trainer.collector.collect()
        # Uniform actions have a std of 1.15.
        assert rollout["action"].std() < 1.0
        update(rollout)
        changed = []
        for before, network in zip(first, networks, strict=True):
            pairs = zip(before, network.parameters(), strict=True)
            changed.append(any(not torch.equal(a, b) for a, b in pairs))
        found.append(changed)
    # Of the policy, and of its critics.
    assert found == [[False, False], [False, True], [False, True], [True, True]]


@pytest.mark.full
def test_the_return_of_a_cloned_policy_is_kept():
    """Critics that know nothing take a part of the return, and little where they learn first."""
    clone = clone_for("fast_sac", noise=0.4)
    slow = replace(OBJECTIVES["fast_sac"], actor_learning_rate=3e-4)
    lowest = {}
    for starts in (0, 200):
        trainer = make_trainer(
            "fast_sac", objective=slow, data={"policy_starts": starts}, iterations=100
        )
        load_networks(trainer.update, clone, Path("clone"))
        assert trainer.evaluator().return_mean > 0.998 * BEST_RETURN
        returns = []
        for number in range(100):
            trainer.iterate()
            if number % 3 == 0:
                returns.append(trainer.evaluator().return_mean)
        lowest[starts] = min(returns)
    print(f"lowest return by policy_starts: {lowest}")
    assert lowest[0] < 0.995 * BEST_RETURN < lowest[200]


@pytest.mark.parametrize(("starts", "steps", "learns_at"), [(8, 4, 8), (11, 6, 12), (20, 32, 32)])
def test_a_policy_that_starts_before_its_critics_is_refused(starts, steps, learns_at):
    data = {"num_env_states_per_minibatch": 8, "num_minibatches": 1, "learning_starts": 8}
    ReplayCfg(**data, num_steps=steps, policy_starts=learns_at + 1)
    with pytest.raises(ValueError, match=f"policy_starts={starts} is not beyond step {learns_at},"):
        ReplayCfg(**data, num_steps=steps, policy_starts=starts)


def test_weights_for_actions_of_another_range_are_refused():
    update = make_trainer("sac").update
    state = update.state_dict()
    high = next(name for name in state["actor"] if name.endswith(".high"))
    state["actor"] = {**state["actor"], high: torch.tensor([3.0])}
    with pytest.raises(
        ValueError, match=r"modules\.actor\.action_bound: .* \[2\.0\] in this run and \[3\.0\]"
    ):
        update.load_weights(state)


def test_noise_differs_by_env_and_changes_with_the_episode():
    trainer = make_trainer("fast_td3")
    scales = trainer.update.behavior.noise_scale_E1
    first = scales.clone()
    assert (
        first.unique().shape[0] == 32 and float(first.min()) >= 0.05 and float(first.max()) <= 0.3
    )
    trainer.iterate()
    assert torch.equal(scales, first)
    trainer.iterate()  # step 8 ends the episodes
    assert not (scales == first).any()


@pytest.mark.parametrize("name", NAMES)
def test_no_host_sync(name):
    offline = OfflineCfg(source="made_up") if name == "sac" else None
    trainer = make_trainer(
        name, data={"n_step": 2, "prioritized": name == "fast_sac", "offline": offline}
    )
    if offline:
        before = trainer.update.actor[0].module.normalizer.count.clone()
        trainer.update.learn_also_from(recorded_table(n_step=2))
        assert trainer.update.actor[0].module.normalizer.count == before + 64
    for _ in range(3):
        trainer.iterate()
    rollout = trainer.collector.collect()
    with count_syncs() as syncs:
        trainer.update(rollout)
        trainer.update.metrics()
    assert syncs.total == 0, syncs.report()


def test_steps_that_are_not_finite_change_nothing_and_end_the_run():
    trainer = make_trainer("sac", objective=SACCfg(alpha_init=0.02, max_skipped_steps=5))
    for _ in range(2):
        trainer.iterate()
    update = trainer.update
    with torch.no_grad():
        update.critic.module.layers[0].weight[0, 0, 0] = float("nan")
    before = [parameter.clone() for parameter in update.actor.parameters()]
    with pytest.raises(NonFiniteStepsError):
        trainer.iterate()
    assert all(torch.equal(a, b) for a, b in zip(before, update.actor.parameters(), strict=True))


def test_a_step_is_skipped_where_the_actors_part_is():
    update = make_trainer("fast_sac").update
    of_critic, of_actor = torch.tensor([1.0, 0, 0, 0, 1, 1, 0, 0]), torch.tensor([0.0, 1, 0, 1])
    assert update.cfg.policy_delay == 2 and int(update._counted_(of_critic, of_actor)) == 3
    # 1, 0, 0, 1, 1, 1, 0, 1
    assert (int(update.guard.skipped), int(update.guard.skipped_in_a_row)) == (5, 1)


def test_rollouts_that_are_not_finite_reach_no_gradient():
    trainer = make_trainer("fast_sac")
    for _ in range(2):
        trainer.iterate()
    rollout = trainer.collector.collect()
    rollout["next", "reward"][3, 1] = float("nan")
    rollout["actor"][5, 0] = float("inf")
    trainer.update(rollout)
    metrics = trainer.update.metrics()
    assert metrics["update/non_finite_env_states"] == 2 and metrics["update/skipped_steps"] == 0
    assert all(parameter.isfinite().all() for parameter in trainer.update.loss.parameters())


def test_the_actor_makes_a_step_for_so_many_of_the_critics():
    trainer = make_trainer("fast_sac")
    for _ in range(2):
        trainer.iterate()
    update = trainer.update
    steps = {
        name: next(iter(optimizer.state.values()))["step"]
        for name, optimizer in update.optimizers.items()
    }
    assert update.cfg.policy_delay == 2 and steps["critic"] == 2 * steps["actor"] > 0


def test_priorities_follow_the_errors():
    trainer = make_trainer("sac", data={"prioritized": True})
    for _ in range(4):
        trainer.iterate()
    replay = trainer.update.replay
    priority = replay.sampler.state_dict()["priority"][replay.storage.available]
    assert priority.unique().shape[0] > 100 and (priority > 0.0).all()


def test_a_delay_must_divide_the_gradient_steps():
    with pytest.raises(ValueError, match="num_minibatches=7"):
        make_trainer("fast_sac", data={"num_minibatches": 7})


@pytest.mark.parametrize(
    ("name", "prioritized"),
    [
        ("sac", False),
        ("fast_td3", True),
        pytest.param("sac", True, marks=pytest.mark.full),
        pytest.param("fast_td3", False, marks=pytest.mark.full),
    ],
)
def test_a_resumed_run_is_the_same_run(name, prioritized, tmp_path):
    options = {"data": {"prioritized": prioritized, "n_step": 2}, "objective": None}
    if name == "sac":
        options["objective"] = SACCfg(alpha_init=0.1)
    straight = make_trainer(name, seed=3, **options)
    for _ in range(8):
        straight.iterate()
    half = make_trainer(name, tmp_path / "run", seed=3, **options)
    for _ in range(4):
        half.iterate()
    saved = half.save()
    resumed = make_trainer(name, seed=99, **options)
    resumed.load(saved)
    for _ in range(4):
        resumed.iterate()
    compared = _compare(straight.state_dict(), resumed.state_dict())
    # Networks, targets, moments, ring, priorities, noise, env and generators.
    assert compared > 50


def _compare(one, other, path=""):
    assert type(one) is type(other) and (not isinstance(one, dict) or one.keys() == other.keys()), (
        path
    )
    if isinstance(one, dict):
        return sum(_compare(one[key], other[key], f"{path}/{key}") for key in one)
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other), path
        return 1
    assert one == other or path == "/seconds", path
    return 0


def test_without_a_saved_replay_a_resumed_run_warms_up_again(tmp_path):
    options = {"data": {"save_replay": False, "offline": OfflineCfg(source="made_up")}}
    trainer = make_trainer("sac", tmp_path / "run", **options)
    resumed = make_trainer("sac", **options)
    for each in (trainer, resumed):
        each.update.learn_also_from(recorded_table())
    for _ in range(4):
        trainer.iterate()
    resumed.load(trainer.save())
    assert resumed.update.metrics()["replay/env_states"] == 0
    assert torch.equal(*(next(iter(one.update.actor.parameters())) for one in (trainer, resumed)))
    assert resumed.collector.collect()["action"].std() > 1.0


def test_weights_alone_start_another_run():
    trainer, other = make_trainer("sac"), make_trainer("sac", seed=1)
    for _ in range(3):
        trainer.iterate()
    other.update.load_weights(trainer.update.state_dict())
    for name in ("actor", "critic", "target_critic"):
        mine, its = trainer.update.state_dict()[name], other.update.state_dict()[name]
        assert all(torch.equal(mine[key], its[key]) for key in mine)
    assert other.update.metrics()["replay/env_states"] == 0
    with pytest.raises(ValueError, match="actor"):
        other.update.load_weights({"actor": {}, "critic": {}, "target_critic": {}})
