"""The curves of healthy and of sabotaged runs, as `benchmarks.diagnosis` recorded them."""

import json
from functools import cache
from pathlib import Path

from ksim_rl.diagnosis.curves import Curves

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"

# What stands in for a sabotaged run that has not been recorded yet: a healthy one with these metrics.
INJECTED = {
    "negative_explained_variance": {"update/explained_variance": -1.5},
}


@cache
def recorded(group):
    """Return the curves of `healthy` or of `faults`, by name."""
    runs = json.loads((RESULTS / "diagnosis.json").read_text())[group]
    found = {
        name: Curves(columns=_columns(run["metrics"]), config=run["config"])
        for name, run in runs.items()
    }
    if group == "faults":
        healthy = recorded("healthy")["cartpole_swingup_ppo_1"]
        for name in INJECTED.keys() - found.keys():
            columns = {
                **healthy.columns,
                **{metric: [value] * 30 for metric, value in INJECTED[name].items()},
            }
            found[name] = Curves(columns=columns, config=healthy.config)
    return found


@cache
def of_the_gpu():
    """Return the curves of training runs that other benchmarks recorded, which have rewards and episodes only."""
    found = {}
    for path in sorted(RESULTS.rglob("learning_*.json")):
        for name, points in json.loads(path.read_text()).get("curves", {}).items():
            names = {metric for point in points for metric in point}
            columns = {metric: [point.get(metric) for point in points] for metric in names}
            found[f"{path.parent.name}/{path.stem}/{name}"] = Curves(columns=columns)
    return found


def _columns(metrics):
    return {
        name: [None if word == "-" else float(word) for word in text.split()]
        for name, text in metrics.items()
    }
