"""Finds runs in folders, and sums each up from the files that it has written so far."""

import csv
import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from ksim_rl.files.reading import MOST_CONFIG_BYTES, read_bytes
from ksim_rl.runs import record
from ksim_rl.runs.csv_table import STEP, read_table
from ksim_rl.terminal import printable

CONFIG = "config.yaml"
METRICS = "metrics.csv"
# Read without YAML: a list of hundreds of runs should take no time.
_TASK = re.compile(r"^task_name: *['\"]?([\w.+-]+)", re.MULTILINE)
# Rows of metrics that the speed is the median of: the first ones compile.
LATEST = 50


@dataclass(frozen=True, kw_only=True)
class Summary:
    """How a run stands; None where it has no such figure yet.

    `evaluation` is the mean return of the last evaluation, `episodes` of the last training episodes; `speed` is in
    env states per second, without evaluations and checkpoints.
    """

    folder: Path
    task: str
    status: str
    why: str
    began: str
    iteration: int | None
    env_states: int | None
    seconds: float | None
    evaluation: float | None
    episodes: float | None
    speed: float | None


HEADS = (
    "run",
    "task",
    "status",
    "began",
    "iteration",
    "env states",
    "time",
    "evaluation",
    "return",
    "env states/s",
)


def find(folder: Path) -> list[Path]:
    """Return the run folders in a folder, itself included, by path; links are not followed."""
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; runs lie in runs/ where they were started")
    return sorted(_walk(folder))


def _walk(folder: Path) -> Iterator[Path]:
    for root, folders, files in os.walk(folder):
        # The config alone is not enough: a folder of configs has one, too.
        if CONFIG in files and (
            "checkpoint" in folders or record.RECORD in files or METRICS in files
        ):
            folders.clear()  # a run holds no other
            yield Path(root)


def summarize(folder: Path) -> Summary:
    """Sum up a run; files that cannot be read are named in `why`."""
    status, why = record.status(folder)
    # A run with damaged files is still listed, with the reason.
    faults = [why] if why else []
    rows: list[dict[str, str]] = []
    task = began = "?"
    try:
        sessions = record.read(folder)
        began = sessions[0].began if sessions else "?"
        text = read_bytes(folder / CONFIG, limit=MOST_CONFIG_BYTES).decode(errors="replace")
        if found := _TASK.search(text):
            task = found[1]
        else:
            task = "?"
        rows = metric_rows(folder)
    except (ValueError, csv.Error) as error:
        faults.append(printable(str(error)))
    # The median, as evaluations and other programs slow single rows down.
    speeds = numbers(rows[-LATEST:], "throughput/env_states_per_s")
    iteration = last(rows, "iteration")
    env_states = last(rows, STEP)
    return Summary(
        folder=folder,
        task=task,
        status=status,
        # The same fault may be found by the record and by the list.
        why="; ".join(dict.fromkeys(faults)),
        began=began,
        iteration=None if iteration is None else int(iteration),
        env_states=None if env_states is None else int(env_states),
        seconds=last(rows, "seconds"),
        evaluation=last(rows, "evaluation/return_mean"),
        episodes=last(rows, "episode/return"),
        speed=median(speeds) if speeds else None,
    )


def metric_rows(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run's metrics; none where it has not written any."""
    if (folder / METRICS).exists():
        return read_table(folder / METRICS)[1]
    return []


def numbers(rows: Sequence[dict[str, str]], name: str) -> list[float]:
    """Return a metric's finite values, oldest first."""
    # A cell may be empty or not finite.
    return [value for row in rows if math.isfinite(value := _number(row.get(name)))]


def last(rows: Sequence[dict[str, str]], name: str) -> float | None:
    """Return a metric's last finite value, or None."""
    # Only the newest row that has the metric is looked at.
    for row in reversed(rows):
        if row.get(name):
            found = numbers([row], name)
            return found[0] if found else None
    return None


def _number(text: str | None) -> float:
    try:
        return float(text or "nan")
    except ValueError:
        return math.nan


def line(summary: Summary, *, name: str) -> list[str]:
    """Return a run as the cells of a table with the columns `HEADS`."""
    # Of a run that is done there is nothing to explain.
    if summary.why and summary.status != "done":
        status = f"{summary.status} ({summary.why})"
    else:
        status = summary.status
    return [
        printable(name),
        summary.task,
        status,
        summary.began,
        written(summary.iteration, ","),
        written(summary.env_states, ","),
        duration(summary.seconds),
        written(summary.evaluation, ".4g"),
        written(summary.episodes, ".4g"),
        written(summary.speed, ",.0f"),
    ]


def written(value: float | None, pattern: str) -> str:
    """Write a figure, "-" where there is none."""
    if value is None:
        return "-"
    return format(value, pattern)


def duration(seconds: float | None) -> str:
    """Write a duration as h:mm:ss."""
    if seconds is None:
        return "-"
    minutes, second = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{second:02d}"
