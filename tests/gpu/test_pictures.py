"""Pictures on a GPU: rollout and update as one graph each, without a wait, and with equal bits in equal runs."""

import pytest
import torch

from ksim_rl import conf
from ksim_rl.device import state_tree
from ksim_rl.trainers import build
from tests.gpu.no_syncs import no_syncs

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
# Of the task's stacks.
STEPS_BETWEEN_FRAMES = 4


def make(*overrides):
    words = [
        "task=cartpole_balance_pixels",
        "device=cuda",
        "logger=none",
        "num_envs=32",
        "data.num_env_states_per_minibatch=64",
        "data.num_minibatches=4",
        "task.episode_length_s=0.1",
        "trainer.eval_episodes=0",
    ]
    return build(conf.compose([*words, *overrides]))


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_rollout_and_update_are_one_graph_each_and_equal_the_eager_ones(precision):
    trainer = make(f"objective.precision={precision}")
    update, collector = trainer.update, trainer.collector
    for _ in range(5):
        update(collector.collect())
    assert collector._run.ready and update._run.ready
    with no_syncs():
        rollout_ET = collector.collect()
    frames_ETNHWC = rollout_ET["actor"]
    assert frames_ETNHWC.dtype == torch.uint8 and frames_ETNHWC.shape == (32, 8, 3, 64, 64, 3)
    # Pictures follow the worlds inside of the graph, and a stack has what was the newest picture some steps before.
    assert not torch.equal(frames_ETNHWC[:, 0, -1], frames_ETNHWC[:, 1, -1])
    following_ETNHWC = rollout_ET["next", "actor"]
    goes_on_E = ~rollout_ET["next", "done"][:, :STEPS_BETWEEN_FRAMES].flatten(1).any(1)
    assert goes_on_E.any()
    before_EHWC = frames_ETNHWC[goes_on_E, 0, -1]
    assert torch.equal(frames_ETNHWC[goes_on_E, STEPS_BETWEEN_FRAMES, -2], before_EHWC)
    assert torch.equal(following_ETNHWC[goes_on_E, STEPS_BETWEEN_FRAMES - 1, -2], before_EHWC)
    state = state_tree.join(*state_tree.split(update.state_dict()))
    with no_syncs():
        update(rollout_ET)
    captured = weights(update)
    update.load_state_dict(state)
    before = weights(update)
    update._update()
    loose = {"float32": 1e-4, "bfloat16": 1e-2}[precision]
    for name, leaf in weights(update).items():
        torch.testing.assert_close(captured[name], leaf, atol=loose, rtol=loose)
    assert any(not torch.equal(before[name], leaf) for name, leaf in captured.items())


def test_equal_runs_have_equal_bits():
    runs = []
    for _ in range(2):
        trainer = make()
        for _ in range(8):
            trainer.update(trainer.collector.collect())
        frames = trainer.collector.collect()["actor"].clone()
        runs.append({**weights(trainer.update), "frames": frames})
    one, other = runs
    differ = [name for name, leaf in one.items() if not torch.equal(leaf, other[name])]
    assert not differ


def weights(update):
    """Return copies of all that an update learns, by name."""
    parts = {"actor": update.actor, "critic": update.critic}
    return {
        f"{part}.{name}": leaf.clone()
        for part, module in parts.items()
        for name, leaf in module.state_dict().items()
    }
