"""AMP: the style of a motion is recovered without any other reward, resume is exact, physics gives the features."""

import dataclasses
import math

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl import conf
from ksim_rl.device import state_tree
from ksim_rl.objectives import AMPCfg
from ksim_rl.scene.motions import MotionSet
from ksim_rl.testing import count_syncs
from ksim_rl.trainers import build
from tests.algorithms.imitation_problems import TURN, PlaneEnv, make_amp


def turns(actor):
    """Return how far from the circle a policy without noise is, and by how much it turns per step, each [E, T]."""
    env = PlaneEnv(64)
    env.set_seed(99)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout_ET = env.rollout(16, actor, break_when_any_done=False)
    before, after = rollout_ET["actor"], rollout_ET["next", "actor"]
    cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    return (after.norm(dim=-1) - 1.0).abs(), torch.atan2(cross, (before * after).sum(-1))


@pytest.mark.full
def test_a_circle_is_walked_in_the_motions_direction_and_speed_without_another_reward():
    trainer = make_amp(iterations=45)
    off_ET, turn_ET = turns(trainer.update.actor)
    assert (turn_ET - TURN).abs().mean() > 0.3, "it must not be solved from the start"
    trainer.train()
    off_ET, turn_ET = turns(trainer.update.actor)
    assert off_ET.mean() < 0.15
    # A step of the motion is 0.5 rad; a policy that only stays on the circle is off by 0.5 or more.
    assert (turn_ET - TURN).abs().mean() < 0.15
    assert trainer.metrics["style/reward"] > 0.6
    # Near its end the game is a draw.
    assert abs(trainer.metrics["style/policy_score"]) < 0.3


def test_both_rewards_are_summed_for_ppo_and_the_rollout_keeps_its_own():
    trainer = make_amp(cfg={"task_coeff": 0.25, "style_coeff": 2.0})
    update = trainer.update
    rollout_ET = trainer.collector.collect()
    rollout_ET["next", "reward"].normal_()
    own_ET = rollout_ET["next", "reward"].clone()
    seen = []
    update.ppo = type(
        "Watched", (), {"__call__": lambda _, td: seen.append(td), "metrics": lambda _: {}}
    )()
    with torch.no_grad():
        pairs = torch.stack((rollout_ET["style"], rollout_ET["next", "style"]), -2)
        score_ET = update.discriminator(pairs)
    update(rollout_ET)
    style_ET = (1.0 - 0.25 * (score_ET - 1.0) ** 2).clamp_min(0.0)
    torch.testing.assert_close(
        seen[0]["next", "reward"][..., 0], 0.25 * own_ET[..., 0] + 2.0 * style_ET
    )
    assert torch.equal(rollout_ET["next", "reward"], own_ET)


def test_the_discriminator_sees_the_last_rollouts_and_normalizes_by_what_it_saw():
    trainer = make_amp(cfg={"replay_rollouts": 3})
    update = trainer.update
    counted = update.discriminator.normalizer.count.item()
    assert counted == 2 * len(update.reference_N2L)
    for iteration in range(1, 6):
        trainer.iterate()
        # An episode's end takes a place for its terminal observation.
        assert update.replay.num_stored <= min(iteration, 3) * 1024
        # 8 steps, as many transitions of the motion as of the policy, two states each.
        assert update.discriminator.normalizer.count == counted + iteration * 8 * 2 * 256 * 2


def test_logit_decay_keeps_the_last_layer_small():
    norms = []
    for logit_decay in (0.0, 20.0):
        trainer = make_amp(cfg={"logit_decay": logit_decay})
        trainer.iterate()
        norms.append(trainer.update.discriminator.layers[-1].weight.norm())
    assert norms[1] < 0.99 * norms[0]


def test_an_update_makes_no_host_sync_and_survives_what_is_not_finite():
    trainer = make_amp()
    update = trainer.update
    for _ in range(2):
        trainer.iterate()
    with count_syncs() as syncs:
        rollout_ET = trainer.collector.collect()
        update(rollout_ET)
        update.metrics()
    assert syncs.total == 0, syncs.report()
    rollout_ET["next", "style"][3, 2] = float("nan")
    update(rollout_ET)
    metrics = update.metrics()
    assert metrics["update/skipped_steps"] == 0 and metrics["update/non_finite_env_states"] == 1
    assert all(value.isfinite() for value in metrics.values())
    parameters = [*update.discriminator.parameters(), *update.actor.parameters()]
    assert all(parameter.isfinite().all() for parameter in parameters)
    with torch.no_grad():
        update.discriminator.layers[0].weight[0, 0] = float("inf")
    before = [parameter.clone() for parameter in update.discriminator.parameters()][1:]
    update(trainer.collector.collect())
    assert update.guard.skipped == 8 and update.metrics()["update/skipped_in_a_row"] == 8
    after = list(update.discriminator.parameters())[1:]
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))


def test_a_resumed_run_is_bit_identical(tmp_path):
    straight = make_amp(iterations=6)
    straight.train()
    make_amp(tmp_path, iterations=3).train()
    resumed = make_amp(iterations=6, seed=9)
    resumed.load(tmp_path)
    resumed.train()
    (tensors, values), (others, other_values) = (
        state_tree.split(trainer.state_dict()) for trainer in (straight, resumed)
    )
    for found in (values, other_values):
        del found["/seconds"]
    assert values == other_values and tensors.keys() == others.keys()
    assert [name for name in tensors if not torch.equal(tensors[name], others[name])] == []
    assert "/update/discriminator/layers.0.weight" in tensors


def test_weights_of_plain_ppo_are_a_start():
    trained = make_amp(seed=3)
    state = trained.update.ppo.state_dict()
    trainer = make_amp()
    discriminator = trainer.update.discriminator.layers[0].weight.clone()
    trainer.update.load_weights(state)
    assert torch.equal(
        next(trainer.update.actor.parameters()), next(trained.update.actor.parameters())
    )
    assert torch.equal(trainer.update.discriminator.layers[0].weight, discriminator)
    trainer.update.load_weights(trained.update.state_dict())
    assert not torch.equal(trainer.update.discriminator.layers[0].weight, discriminator)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"motions": ()}, "motions=.*name at least one reference motion"),
        ({"style_coeff": -1.0}, "style_coeff=-1.0"),
        ({"gradient_penalty": math.nan}, "gradient_penalty"),
        ({"discriminator_learning_rate": 0.0}, "discriminator_learning_rate=0.0"),
        ({"replay_rollouts": 2}, "replay_rollouts=2: expected a whole number >= 3"),
        ({"num_discriminator_steps": 1.5}, "num_discriminator_steps=1.5"),
        ({"clip_epsilon": 0.0}, "clip_epsilon"),
    ],
)
def test_values_out_of_range_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        AMPCfg(**{"motions": ("walker_walk",), **fields})


def test_a_motion_whose_features_are_not_finite_is_refused():
    with pytest.raises(ValueError, match="group 'style' is not finite"):
        make_amp(reference=torch.full((4, 2, 2), math.nan))


# -- in physics ------------------------------------------------------------------------------------------------------

SMALL = [
    "task=walker_amp",
    "task.sim.engine=c",
    "objective=amp",
    "device=cpu",
    "logger=none",
    "num_envs=4",
    "data.num_env_states_per_minibatch=16",
    "data.num_minibatches=2",
    "objective.num_transitions_per_step=32",
    "modules.actor.hidden_dims=[8]",
    "modules.critic.hidden_dims=[8]",
    "trainer.num_threads=1",
    "trainer.eval_episodes=0",
]


def test_a_run_compares_transitions_that_last_one_env_step():
    cfg = conf.compose([*SMALL, "objective.motions=[clips]"])
    # A set that no term of the task reads.
    motions = {"clips": MotionSet(sources=("walker_walk",))}
    scene = dataclasses.replace(cfg.task.scene, motions=motions)
    task = dataclasses.replace(cfg.task, scene=scene)
    trainer = build(dataclasses.replace(cfg, task=task))
    update = trainer.update
    # Eight seconds in steps of 20 ms.
    assert update.reference_N2L.shape == (400, 2, 19)
    assert torch.equal(update.reference_N2L[1:, 0], update.reference_N2L[:-1, 1])
    trainer.iterate()
    trainer.iterate()
    assert trainer.metrics["update/skipped_steps"] == 0
    assert 0.0 <= trainer.metrics["style/reward"] <= 1.0
    # Episodes begin in states of the motion, so that the first features are among its own.
    first_E = trainer.collector.env.reset()["style"]
    features_NL = update.reference_N2L[:, 0]
    nearest_E = torch.cdist(first_E, features_NL).amin(-1)
    assert nearest_E.max() < 0.1 * torch.cdist(features_NL, features_NL).median()


def test_a_style_group_that_the_task_lacks_is_refused():
    with pytest.raises(ValueError, match=r"no group 'gait', which .* objective.style_group name"):
        conf.compose([*SMALL, "objective.style_group=gait"])
