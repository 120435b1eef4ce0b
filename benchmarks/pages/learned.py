"""Makes the tables of docs/learning.md that say how well the algorithms learn."""

import json
import statistics
from typing import Any

from benchmarks import report
from benchmarks.pages.table import table

# Robot, objective, and the table and row of its results.
WALKING = (
    ("Go1", "ppo", "velocity", "ppo/go1"),
    ("Go1", "fast_sac", "velocity", "fast_sac/go1"),
    ("G1", "fast_sac", "humanoids", "g1_flat"),
)
# What each is of 23 tasks in the publications that docs/suites.md and the table of results name.
SUITE = (
    ("`objective=fast_sac`", "fast_sac", "5 million, 10 of humanoid, hopper, acrobot and pendulum"),
    ("MuJoCo Playground's SAC", 659, "5 or 10 million"),
    ("`objective=ppo`", "ppo", "15 to 88 million, 176 of AcrobotSwingup"),
    ("MuJoCo Playground's PPO", 596, "88 or 177 million"),
    ("REPPO", 749, "200 million"),
)


def results(name: str) -> dict[str, Any]:
    """Return a table of results."""
    return json.loads((report.RESULTS / "tables" / f"{name}.json").read_text())


def walking() -> str:
    """Return the table of seconds and env states until robots follow their commands."""
    rows = []
    for robot, objective, name, key in WALKING:
        runs = results(name)["rows"][key]["runs"]
        # A seed that does not get there counts as infinite, and has no number.
        reached = [run for run in runs if run["seconds_to_levels"] is not None]
        if 2 * len(reached) <= len(runs):
            raise ValueError(
                f"{name}.json: the median of {key} is infinite: give the page a sentence on it"
            )
        missing = [float("inf")] * (len(runs) - len(reached))
        seconds = statistics.median([run["seconds_to_levels"] for run in reached] + missing)
        env_states = statistics.median([run["env_states_to_levels"] for run in reached] + missing)
        linked = f"[`{objective}`](../benchmarks/results/tables/{name}.md)"
        seeds = f"{len(reached)} of {len(runs)}"
        rows.append([robot, linked, f"{seconds:.1f} s", f"{env_states / 1e6:.1f} million", seeds])
    return table(("robot", "objective", "follows its command after", "env states", "seeds"), rows)


def suite() -> str:
    """Return the table of mean returns over the tasks of the Control Suite that others report."""
    figures = results("dm_control")["figures"]
    rows = []
    for label, value, env_states in SUITE:
        if isinstance(value, str):
            rows.append([label, f"**{figures[f'dm_control/{value}/mean_23']:.0f}**", env_states])
        else:
            rows.append([label, str(value), env_states])
    return table(("", "mean of 23 tasks", "env states of a task"), rows)
