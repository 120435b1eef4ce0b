"""The page of tasks shows figures of the last run on a GPU, what the tables of results have, and right sizes."""

import pytest

from benchmarks.pages.tasks import NOTHING, built_sizes, learned, measured, own_tasks, written_sizes
from tests.absent_models import skipped_without_models


def test_the_figures_are_those_of_the_last_run_on_a_gpu():
    dates = {
        "cpu/reacher/4096": "3",
        "h200/reacher/4096": "2",
        "h100/reacher/4096": "1",
        "h200/reacher/8": "4",
    }
    saved = {
        "runs": {prefix: {"date": date} for prefix, date in dates.items()},
        "outcomes": {prefix: {"check_env": f"passed {prefix}"} for prefix in dates},
        "figures": {
            "h200/reacher/4096/env_states_per_s": 1234567.8,
            "h200/reacher/4096/syncs": 0.0,
            "h100/reacher/4096/rollout_over_physics": 0.5,
        },
    }
    assert measured("reacher", saved) == ("1,234,568", NOTHING, "0", "passed h200/reacher/4096")
    assert measured("walker_run", saved) == (NOTHING,) * 4


def result(commit="abcdef012", **fields):
    return {"commit": commit, "device": "NVIDIA H200", "env_states": 6e7, "seconds": 40.0} | fields


def test_what_was_learned_is_what_the_tables_have():
    means = {"reward/track_linear_velocity": 1.5, "reward/track_angular_velocity": 1.2}
    go2 = [
        result(evaluation={"return_mean": 80.0}, means=dict(means)),
        result(
            evaluation={"return_mean": 84.0},
            means=means | {"reward/track_angular_velocity": 0.94},
            seconds=50.0,
        ),
    ]
    tables = {
        "tasks": {
            "rows": {
                "velocity/go2_velocity_flat": {
                    "reached": False,
                    "value": 82.0,
                    "goal": None,
                    "runs": go2,
                },
                "control/reacher": {
                    "reached": True,
                    "value": 941.6,
                    "goal": 930.0,
                    "runs": [result(evaluation={"return_mean": 941.6}, means={}, device="CPU")],
                },
            }
        },
        "tracking": {
            "rows": {
                "kick": {
                    "reached": True,
                    "value": 0.999,
                    "goal": 0.95,
                    "runs": [result("0123456789", evaluation={"return_mean": 21.04})],
                }
            }
        },
    }
    text = learned(tables)
    for line in (
        "Runs are of CPU and NVIDIA H200, at commit abcdef0, but `g1_track_kick` at 0123456.",
        "| `go2_velocity_flat` | ppo | 60.0 million | 45 | 82.0 ± 2.8 | "
        "track_linear_velocity 1.50 (1.3), track_angular_velocity 0.94 (1) | no | 2 |",
        "| `reacher` | ppo | 60.0 million | 40 on a CPU | 941.6 | return 941.6 (930) | yes | 1 |",
        "| `g1_track_kick` | ppo | 60.0 million | 40 | 21.0 | followed 0.999 (0.95) | yes | 1 |",
        "| `walker_amp` | amp | not measured | – | – | – | – | – |",
    ):
        assert line in text.splitlines(), text
    timed = {
        "reached": True,
        "value": 26.04,
        "goal": 100.0,
        "runs": [result(evaluation={"return_mean": 99.0})],
    }
    assert (
        "| `g1_velocity_flat` | fast_sac | 60.0 million | 40 | 99.0 | "
        "rewards of 1.40 and 1.00 after 26.0 s (100) | yes | 1 |"
    ) in learned({"humanoids": {"rows": {"g1_flat": timed}}}).splitlines()
    assert "commit abcdef0." in learned({"tasks": tables["tasks"]})
    del go2[0]["means"]["reward/track_linear_velocity"]
    assert "track_linear_velocity not logged (1.3)" in learned(tables)
    assert "Runs are" not in learned({}) and learned({}).count("not measured") == len(own_tasks())


@pytest.mark.full
def test_the_sizes_are_those_of_the_envs():
    with skipped_without_models():
        sizes = built_sizes()
    assert written_sizes() == sizes, "python -m benchmarks.pages --sizes"
