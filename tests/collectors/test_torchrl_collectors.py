"""Every collector class of TorchRL 0.14 takes our envs."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl import collectors
from torchrl.envs import EnvCreator

from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import ActionDelay, DelayCfg

E, T = 3, 6


def make():
    return MaskedTransformedEnv(
        CounterEnv((3, 5, 4)), ActionDelay(delay=DelayCfg(min_lag=0, max_lag=1))
    )


def make_single():
    return CounterEnv(())


def policy():
    return TensorDictModule(nn.Linear(1, 2), in_keys=["count"], out_keys=["action"])


SIZES = {"frames_per_batch": E * T, "total_frames": 2 * E * T}
KINDS = {
    "Collector": lambda: collectors.Collector(make, policy(), **SIZES),
    "Collector of a creator": lambda: collectors.Collector(EnvCreator(make), policy(), **SIZES),
    "split": lambda: collectors.Collector(make, policy(), split_trajs=True, **SIZES),
    "AsyncCollector": lambda: collectors.AsyncCollector(make, policy(), **SIZES),
    "MultiAsyncCollector": lambda: collectors.MultiAsyncCollector([make, make], policy(), **SIZES),
    "MultiSyncCollector": lambda: collectors.MultiSyncCollector(
        [make, make], policy(), frames_per_batch=2 * E * T, total_frames=4 * E * T
    ),
    "MultiCollector": lambda: collectors.MultiCollector(
        [make, make], policy(), sync=True, frames_per_batch=2 * E * T, total_frames=4 * E * T
    ),
    "AsyncBatchedCollector": lambda: collectors.AsyncBatchedCollector(
        [make_single, make_single], policy=policy(), frames_per_batch=T, total_frames=2 * T
    ),
}


def test_no_class_is_left_out():
    offered = {name for name in collectors.__all__ if name.endswith("Collector")} - {
        "BaseCollector"
    }
    assert offered == {name.split()[0] for name in KINDS} - {"split"}


@pytest.mark.parametrize(
    "kind",
    [
        "Collector",
        "Collector of a creator",
        "split",
        *(
            pytest.param(name, marks=pytest.mark.full)
            for name in KINDS
            if "Async" in name or "Multi" in name
        ),
    ],
)
def test_it_collects_what_the_env_does(kind):
    collector = KINDS[kind]()
    try:
        batches = list(collector)
    finally:
        collector.shutdown()
    assert len(batches) >= 2
    for batch in batches:
        mask = batch.get(("collector", "mask"), None)
        steps = batch.reshape(-1) if mask is None else batch[mask]
        assert steps.numel() >= T
        # The count of a step is one more than before it, however the data was stacked.
        torch.testing.assert_close(steps["next", "count"], steps["count"] + 1.0)
        assert steps["next", "reward"].isfinite().all()
