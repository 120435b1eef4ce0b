"""PPO with recurrent networks: probabilities and values as in the rollout, a critic's own state, bit-exact resume."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

from ksim_rl import conf
from ksim_rl.device import state_tree
from ksim_rl.modules import recurrent_modules
from ksim_rl.objectives import rollout_estimator
from ksim_rl.testing import count_syncs
from ksim_rl.trainers import build, load_policy

SMALL = [
    "task=cartpole_balance",
    "device=cpu",
    "logger=none",
    "num_envs=4",
    "data.num_env_states_per_minibatch=16",
    "data.num_minibatches=2",
    "modules.actor.hidden_dims=[8]",
    "modules.critic.hidden_dims=[8]",
    "modules.recurrent_actor.hidden_dim=6",
    "modules.recurrent_critic.hidden_dim=6",
    "task.episode_length_s=0.1",
    "trainer.num_threads=1",
    "trainer.eval_episodes=2",
    "trainer.eval_interval=1",
    "trainer.stop_when_solved=false",
    "trainer.checkpoint_interval=0",
]
SEQUENCES = ["modules=gru", "data.sequence_length=4", "data.burn_in=2"]


def make(*overrides, iterations=2, folder=None):
    cfg = conf.compose([*SMALL, *overrides, f"trainer.num_iterations={iterations}"])
    trainer = build(cfg)
    trainer.folder = folder
    return trainer


@pytest.fixture(scope="module", params=[["modules=lstm"], SEQUENCES], ids=["lstm", "gru"])
def trainer(request):
    trainer = make(*request.param)
    for _ in range(2):
        trainer.update(trainer.collector.collect())
    return trainer


@torch.no_grad()
def test_sequences_have_the_probabilities_that_the_rollout_had(trainer):
    update = trainer.update
    rollout_ET = trainer.collector.collect()
    assert rollout_ET["next", "done"][:, :-1].any(), "the comparison must include resets"
    update._carried.begin_(rollout_ET)
    update.advantage(rollout_ET)
    update._carried.end_(rollout_ET)
    update.dataset.extend(rollout_ET)
    burn_in = update.dataset.cfg.burn_in
    for minibatch_BT in update.dataset.epoch():
        with set_recurrent_mode(True):
            dist = update.actor.get_dist(minibatch_BT.copy())
            values_BT = update.critic(minibatch_BT.copy())["state_value"]
        # Sequences of a rollout's beginning have no steps before them: what stands there is not theirs.
        whole_B = torch.ones(minibatch_BT.shape[0], dtype=torch.bool)
        if burn_in:
            whole_B = minibatch_BT["burn_in"][:, 0, 0]
        log_prob_BT = dist.log_prob(minibatch_BT["action"])
        torch.testing.assert_close(
            log_prob_BT[whole_B], minibatch_BT["action_log_prob"][whole_B], atol=1e-5, rtol=1e-5
        )
        torch.testing.assert_close(
            values_BT[whole_B], minibatch_BT["state_value"][whole_B], atol=1e-5, rtol=1e-5
        )


# All envs at once, or one at a time.
@pytest.mark.parametrize("most_numbers", [rollout_estimator.MOST_NUMBERS, 1])
@torch.no_grad()
def test_values_are_those_of_a_critic_that_walks_along_with_the_env(
    trainer, most_numbers, monkeypatch
):
    monkeypatch.setattr(rollout_estimator, "MOST_NUMBERS", most_numbers)
    update, collector = trainer.update, trainer.collector
    (recurrent,) = recurrent_modules(update.critic)
    state_E = {key: update._carried._state_E[key].clone() for key in recurrent.state_keys}
    rollout_ET = collector.collect()
    update._carried.begin_(rollout_ET)
    update.advantage(rollout_ET)
    update._carried.end_(rollout_ET)
    for t in range(rollout_ET.shape[1]):
        step_E = rollout_ET[:, t].select("critic", "is_init")
        walked_E = update.critic(step_E.update(_nested(state_E)))
        torch.testing.assert_close(
            walked_E["state_value"], rollout_ET["state_value"][:, t], atol=1e-5, rtol=1e-5
        )
        state_E = {key: walked_E[("next", *key)] for key in recurrent.state_keys}
        # The value after the step sees the true next observation, and the state that the step left.
        after_E = rollout_ET["next"][:, t].select("critic").update(_nested(state_E))
        torch.testing.assert_close(
            update.critic(after_E)["state_value"],
            rollout_ET["next", "state_value"][:, t],
            atol=1e-5,
            rtol=1e-5,
        )
    for key, carried_E in update._carried._state_E.items():
        torch.testing.assert_close(carried_E, state_E[key], atol=1e-5, rtol=1e-5)


def _nested(state_E):
    first = next(iter(state_E.values()))
    return TensorDict(dict(state_E.items()), batch_size=first.shape[:1])


def test_an_iteration_makes_no_host_sync(trainer):
    counts = []
    for _ in range(2):
        with count_syncs() as syncs:
            trainer.update(trainer.collector.collect())
            trainer.update.metrics()
        counts.append(syncs)
    # After 4, 8, 16 ... rollouts one is compared with the env's own, which waits: never two in a row.
    fewest = min(counts, key=lambda syncs: syncs.total)
    assert fewest.total == 0, fewest.report()


def parts(trainer):
    tensors, values = state_tree.split(trainer.state_dict())
    del values["/seconds"]
    return tensors, values


@pytest.mark.parametrize(
    "networks",
    [pytest.param(["modules=lstm"], marks=pytest.mark.full), SEQUENCES],
    ids=["lstm", "gru"],
)
def test_a_resumed_run_is_bit_identical(networks, tmp_path):
    straight = make(*networks, iterations=4)
    straight.train()
    make(*networks, iterations=2, folder=tmp_path).train()
    resumed = make(*networks, "seed=5", iterations=4)
    resumed.load(tmp_path)
    resumed.train()
    (tensors, values), (others, other_values) = parts(straight), parts(resumed)
    assert values == other_values and tensors.keys() == others.keys()
    assert [name for name in tensors if not torch.equal(tensors[name], others[name])] == []
    for state in (
        "/collector/recurrent_state.actor.h",
        "/update/recurrent_state/recurrent_state.critic.h",
    ):
        assert tensors[state].abs().max() > 0.0, state
    assert load_policy(tmp_path, device="cpu").actor.in_keys == resumed.update.actor.in_keys


def test_only_the_critic_may_remember():
    trainer = make(
        "modules=lstm", "~modules.recurrent_actor.hidden_dim", "modules.recurrent_actor=null"
    )
    trainer.train()
    assert (
        recurrent_modules(trainer.update.actor) == []
        and len(recurrent_modules(trainer.update.critic)) == 1
    )


def test_recurrent_layers_above_a_shared_trunk_with_targets_that_follow_the_policy():
    recurrent = "{kind: gru, hidden_dim: 6, num_layers: 1}"
    overrides = ["modules=shared_trunk", f"modules.recurrent_actor={recurrent}"]
    overrides += [f"modules.recurrent_critic={recurrent}", "objective.advantage=vtrace"]
    cfg = conf.compose([*(o for o in SMALL if "hidden_dim=" not in o), *overrides])
    trainer = build(cfg)
    for _ in range(2):
        trainer.iterate()
    metrics = trainer.update.metrics()
    assert metrics["update/skipped_steps"] == 0 and 0.0 < metrics["update/kl"] < 0.1


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["modules=lstm", "data.sequence_length=3"], "sequence_length=3: rollouts have 8 steps"),
        (["modules=lstm", "data.sequence_length=4", "data.burn_in=5"], "burn_in=5 is longer"),
        (["modules=lstm", "objective.symmetry=loss"], "no known mirror image"),
        (["data.sequence_length=4"], "use modules=lstm or modules=gru"),
    ],
)
def test_what_does_not_fit_is_refused_before_any_model_compiles(overrides, message):
    small = [o for o in SMALL if "recurrent" not in o or "modules=lstm" in overrides]
    with pytest.raises(ValueError, match=message):
        conf.compose([*small, *overrides])


def test_whole_rollouts_must_fill_minibatches():
    with pytest.raises(ValueError, match="num_env_states_per_minibatch=16 is no whole number"):
        conf.compose([*SMALL, "modules=lstm", "num_envs=1"])
