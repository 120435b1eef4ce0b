"""Several ranks learn what one process with as many envs and shards learns: gloo, on the CPU."""

import pytest
import torch

from ksim_rl import conf
from ksim_rl.cli.collect import collect
from ksim_rl.device import state_tree
from ksim_rl.trainers import build
from tests.ranks.gloo import results

SMALL = [
    "task=cartpole_balance",
    "task.sim.engine=c",
    "device=cpu",
    "logger=none",
    "task.episode_length_s=0.1",
    "trainer.num_threads=1",
    "trainer.num_iterations=2",
    "trainer.eval_episodes=0",
    "trainer.checkpoint_interval=0",
]
NETWORKS = ["modules.actor.hidden_dims=[8]", "modules.critic.hidden_dims=[8]"]
RECURRENT = [
    *NETWORKS,
    "modules=lstm",
    "modules.recurrent_actor.hidden_dim=6",
    "modules.recurrent_critic.hidden_dim=6",
    "data.num_minibatches=2",
]
REPLAY = [
    "data.num_minibatches=4",
    "data.num_steps=4",
    "data.capacity=32",
    "data.learning_starts=4",
    "modules.actor.hidden_dims=[8]",
    "modules.critic.hidden_dims=[8]",
]
ALGORITHMS = {
    "ppo": [*NETWORKS, "data.num_minibatches=2"],
    "ppo_minibatch_advantages": [
        *NETWORKS,
        "data.num_minibatches=2",
        "objective.normalize_advantage=minibatch",
    ],
    "lstm": RECURRENT,
    "gru": [*RECURRENT, "modules=gru", "data.sequence_length=4", "data.burn_in=2"],
    **{name: [f"objective={name}", *REPLAY] for name in ("sac", "td3", "fast_sac", "fast_td3")},
}

# What a policy sees and follows: pictures by a trunk's encoder, and a motion whose failed parts all ranks count.
TASKS = {
    "pictures": [
        "task=cartpole_balance_pixels",
        # Cameras draw by Warp.
        "task.sim.engine=warp",
        "task.scene.sensors.side.width=36",
        "task.scene.sensors.side.height=36",
        "data.num_minibatches=2",
        # With the task's 0.005 gradients of some weights nearly cancel, and Adam makes steps of their rounding.
        "objective.critic_coeff=1.0",
    ],
    "tracking": [
        *NETWORKS,
        "task=g1_track_walk",
        "task.sim.engine=c",
        "data.num_minibatches=2",
        # Later, statistics of inputs that hardly move make steps of Adam out of differences of rounding.
        "trainer.num_iterations=1",
    ],
}
ALGORITHMS = {**ALGORITHMS, **TASKS}


def trained(overrides, num_envs, minibatch, shards):
    """Return the tensors of an update, and where the envs stand, after two iterations."""
    sizes = [
        f"num_envs={num_envs}",
        f"data.num_env_states_per_minibatch={minibatch}",
        f"data.shards={shards}",
    ]
    trainer = build(conf.compose([*SMALL, *overrides, *sizes]))
    trainer.train()
    learnt, _ = state_tree.split(trainer.update.state_dict())
    envs, _ = state_tree.split(trainer.collector.state_dict())
    return learnt, envs


def largest_difference(learnt, parts):
    """Compare all tensors of one process with each rank's; rows that are shared out are put together."""
    worst = 0.0
    for key, expected in learnt.items():
        # Each rank has the sums of its own observations, and a replay of its own.
        own = key.endswith(("normalizer.count", "exact_mean", "exact_sum_of_squares"))
        own |= key.startswith("/replay/")
        if own or not expected.numel():
            continue
        shared = expected.shape == parts[0][key].shape
        found = (
            [part[key] for part in parts] if shared else [torch.cat([part[key] for part in parts])]
        )
        worst = max(
            [worst, *((one.double() - expected.double()).abs().max().item() for one in found)]
        )
    return worst


def compared(name, size, folder, *more):
    """Train on ranks and in one process; return how many tensors were compared, and their largest difference."""
    overrides = [*ALGORITHMS[name], *more]
    learnt, envs = trained(overrides, 4 * size, 16 * size, size)
    parts = results(trained, overrides, 4, 16, 1, size=size, folder=folder)
    for key, expected in envs.items():
        found = torch.cat([part[1][key] for part in parts])
        torch.testing.assert_close(found, expected, rtol=0.0, atol=1e-4)
    return len(learnt), largest_difference(learnt, [part[0] for part in parts])


def check(name, size, folder, *more):
    tensors, worst = compared(name, size, folder, *more)
    print(f"{name}, {size} ranks: {tensors} tensors, largest difference {worst:.2g}")
    assert worst <= 1e-6


def test_two_ranks_learn_ppo_as_one_process_does(tmp_path):
    check("ppo", 2, tmp_path)


@pytest.mark.full
@pytest.mark.parametrize("size", [2, 4])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_ranks_learn_what_one_process_learns(name, size, tmp_path):
    check(name, size, tmp_path)


@pytest.mark.full
def test_ranks_share_recorded_episodes_as_shards_of_one_process_do(tmp_path):
    recorded = tmp_path / "recorded"
    how = ["--agent", "random", "--episodes", "6", "--device", "cpu", "--output", str(recorded)]
    assert collect([*SMALL[:2], "task.episode_length_s=0.1", *how]) == 0
    check("fast_sac", 2, tmp_path, f"data.offline={{source: {recorded}}}")
