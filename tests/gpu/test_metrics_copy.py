"""Metrics reach the host in one copy that the device does not wait for."""

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from ksim_rl import conf
from ksim_rl.trainers import build
from tests.gpu.no_syncs import no_syncs

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

RUN = (
    "task=cartpole_balance",
    "num_envs=256",
    "device=cuda",
    "data.num_env_states_per_minibatch=1024",
    "data.num_minibatches=4",
    "logger=none",
    "trainer.eval_episodes=0",
)


@pytest.fixture(scope="module")
def trainer():
    """Return a trainer whose graphs are captured."""
    trainer = build(conf.compose(list(RUN)))
    for _ in range(5):
        trainer.iterate()
    assert trainer.collector._run.ready and trainer.update._run.ready
    return trainer


def test_whole_iterations_with_their_reports_make_no_host_sync(trainer):
    with no_syncs():
        for _ in range(5):
            trainer.iterate()
        trainer.settle()
    assert trainer.metrics["iteration"] == trainer.iteration
    assert trainer.metrics["physics/nefc_share"] >= 0.0


def test_an_iteration_copies_to_the_host_once(trainer):
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        for _ in range(3):
            trainer.iterate()
        trainer.settle()
        torch.cuda.synchronize()
    copies = [event for event in profiler.events() if event.name.startswith("Memcpy DtoH")]
    assert len(copies) == 3, [event.name for event in copies]


def test_the_next_iteration_starts_before_the_last_one_is_read(trainer):
    trainer.settle()
    before = trainer.iteration
    trainer.iterate()
    assert [iteration for iteration, _ in trainer._unread] == [before + 1]
    trainer.iterate()
    assert [iteration for iteration, _ in trainer._unread] == [before + 2]
    assert trainer.metrics["iteration"] == before + 1
