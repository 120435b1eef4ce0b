"""The benchmark of both engines writes how much faster C is, of the wall clock and of processor time."""

import math

from benchmarks import command_line
from benchmarks.engines import measure


def test_both_engines_are_timed_and_compared():
    words = [
        "task=cartpole_balance",
        "num_envs=8",
        "device=cpu",
        "logger=none",
        "trainer.eval_episodes=0",
    ]
    words += ["collector.rollout_length=2", "data.num_minibatches=1", "collector.compile=false"]
    figures = measure(command_line.compose(words), repeats=1)
    for name in ("rollout", "physics"):
        expected = figures[f"{name}_warp_ms"] / figures[f"{name}_c_ms"]
        assert math.isclose(figures[f"{name}_c_over_warp"], expected)
        assert figures[f"{name}_c_over_warp_processor_time"] > 0.0
    assert figures["engine_c_over_warp"] == figures["rollout_c_over_warp"]
