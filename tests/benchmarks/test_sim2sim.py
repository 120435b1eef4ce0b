"""The benchmark of sim2sim: the same episodes on both engines, in pairs."""

import numpy as np
import pytest

from benchmarks.sim2sim import OPTIONS, Episodes, compared, differs, group, measure


def episodes(returns: list[float]) -> Episodes:
    return Episodes(
        return_N=np.array(returns),
        length_N=np.full(len(returns), 30.0),
        fell_N=np.zeros(len(returns)),
    )


def test_returns_differ_by_more_than_chance_only_beyond_their_error():
    own = episodes([10.0, 12.0, 11.0, 13.0])
    assert not differs(compared(own, episodes([10.1, 11.9, 11.1, 12.9])))
    lower = compared(own, episodes([9.0, 10.8, 9.9, 11.7]))
    assert lower["return_ratio"] == pytest.approx(0.9)
    assert differs(lower)


def test_figures_stand_where_the_options_say():
    trained = {"task": "go1_velocity_flat", "policy": "zoo:go1", "noise": "false", "label": "one"}
    assert group(trained) == "go1_velocity_flat/without_noise/one"
    assert group({**OPTIONS, "task": "cartpole"}) == "cartpole/standing"


@pytest.mark.parametrize(
    ("engine", "said"),
    [("warp", "(trained on MuJoCo Warp)"), ("c", "which trained it, with integrator euler")],
)
def test_both_engines_run_the_same_episodes(engine, said):
    options = {**OPTIONS, "task": "cartpole_balance", "episodes": "4"}
    figures, words = measure(options, ["task.episode_length_s=0.3", f"task.sim.engine={engine}"])
    assert said in words
    # A pole that hardly moves earns the same to the last bit on both engines, but not in steps half as long.
    assert engine == "warp" or figures["return_c_engine"] != figures["return"]
    assert figures["return_ratio"] == pytest.approx(1.0, abs=1e-3)
    assert figures["length"] == figures["length_c_engine"] == 30.0
