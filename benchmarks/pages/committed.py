"""Reads the committed results of benchmarks, which pages show."""

import json
from collections.abc import Mapping
from typing import Any

from benchmarks import report


def results(name: str) -> dict[str, Any]:
    """Return what a benchmark wrote; nothing if it has not been run."""
    path = report.RESULTS / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else {}


def last_on_gpu(runs: Mapping[str, Mapping[str, Any]]) -> str | None:
    """Return the key of the last run that was not on a CPU."""
    on_gpu = [key for key in runs if not key.startswith("cpu/")]
    return max(on_gpu, key=lambda key: runs[key]["date"], default=None)


def last_run(saved: Mapping[str, Any], *of: str) -> str | None:
    """Return the prefix of the last run on a GPU whose key is a device's label and these words."""
    runs = saved.get("runs", {})
    return last_on_gpu({key: run for key, run in runs.items() if key.split("/")[1:] == [*of]})
