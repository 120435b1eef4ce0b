"""Distillation and AMP on a GPU: one graph per update, the same numbers as eager ones, no waits."""

import pytest
import torch

from ksim_rl import conf
from ksim_rl.device import state_tree
from ksim_rl.trainers import RunProgress, build, run
from tests.gpu.no_syncs import no_syncs

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
SMALL = [
    "device=cuda",
    "logger=none",
    "num_envs=64",
    "data.num_env_states_per_minibatch=256",
    "data.num_minibatches=2",
    "trainer.eval_episodes=0",
    "trainer.checkpoint_interval=0",
    "trainer.video=false",
]


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    folder = tmp_path_factory.mktemp("teacher") / "run"
    cfg = conf.compose(
        [
            *SMALL,
            "task=cartpole_balance",
            "modules.actor.in_keys=[critic]",
            "trainer.num_iterations=2",
        ]
    )
    run(cfg, folder, progress=RunProgress(2, enabled=False))
    return folder


def captured_equals_eager(trainer):
    update, collector = trainer.update, trainer.collector
    for _ in range(5):
        trainer.iterate()
    assert collector._run.ready and update._run.ready
    with no_syncs():
        rollout_ET = collector.collect()
    state = state_tree.join(*state_tree.split(update.state_dict()))
    torch.cuda.manual_seed(7)
    with no_syncs():
        update(rollout_ET)
        update.metrics()
    one = state_tree.split(update.state_dict())[0]
    update.load_state_dict(state)
    # Both draw the same numbers; a graph reads the generator's state when it is replayed.
    torch.cuda.manual_seed(7)
    update._update()
    other = state_tree.split(update.state_dict())[0]
    before = state_tree.split(state)[0]
    networks = [name for name in one if name.startswith(("/actor", "/critic", "/discriminator/"))]
    assert any(not torch.equal(one[name], before[name]) for name in networks)
    for name in networks:
        torch.testing.assert_close(
            one[name], other[name], atol=1e-3, rtol=1e-3, msg=lambda m, n=name: f"{n}: {m}"
        )


@pytest.mark.parametrize("loss", ["kl", "mse"])
@pytest.mark.parametrize("modules", ["mlp", "gru"])
def test_distillation_is_one_graph_and_equals_the_eager_update(loss, modules, teacher):
    overrides = [
        "task=cartpole_balance",
        "objective=distillation",
        f"objective.teacher={teacher}",
        f"objective.loss={loss}",
        "objective.teacher_share=0.5",
        f"modules={modules}",
    ]
    captured_equals_eager(build(conf.compose([*SMALL, *overrides])))


def test_amp_is_one_graph_and_equals_the_eager_update():
    overrides = ["task=walker_amp", "objective=amp", "objective.num_transitions_per_step=512"]
    trainer = build(conf.compose([*SMALL, *overrides]))
    captured_equals_eager(trainer)
    assert trainer.update.metrics()["update/skipped_steps"] == 0
