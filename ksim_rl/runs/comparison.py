"""Runs are compared: their figures, the fields of their configs that differ, and their curves in one picture."""

from collections.abc import Sequence
from pathlib import Path

from ksim_rl.config.plain_data import flat, read_yaml
from ksim_rl.runs import curves
from ksim_rl.runs.csv_table import STEP
from ksim_rl.runs.listing import (
    CONFIG,
    HEADS,
    METRICS,
    line,
    metric_rows,
    numbers,
    summarize,
    written,
)
from ksim_rl.runs.plotting import Figure, FigureCanvasAgg, plain_style
from ksim_rl.terminal import printable

RETURN = ("evaluation/return_mean", "episode/return")
# Title, metrics (the first of which all runs have a curve is drawn), and the horizontal axis.
PANELS = (
    ("Return", RETURN, STEP),
    ("Return", RETURN, "seconds"),
    ("Episode length (env steps)", ("episode/length",), STEP),
    ("Env states per second", ("throughput/env_states_per_s",), STEP),
)
MOST_FIELDS = 60
MOST_LETTERS = 60


# Titles and legends have room for short names only.
def names(folders: Sequence[Path]) -> list[str]:
    """Return short names of run folders: the last parts of their paths that tell them apart."""
    parts = [folder.resolve().parts for folder in folders]
    # From the last part on, until all are different.
    for length in range(1, max(map(len, parts)) + 1):
        short = ["/".join(own[-length:]) for own in parts]
        if len(set(short)) == len(short):
            return short
    return [str(folder) for folder in folders]


def figures(folders: Sequence[Path]) -> list[list[str]]:
    """Return rows of a table with a column per run: its figures, the best return, and where configs differ.

    A ValueError names a folder that is no run, or whose config cannot be read.
    """
    configs = [_config(folder) for folder in folders]
    lines = [
        line(summarize(folder), name=name)
        for folder, name in zip(folders, names(folders), strict=True)
    ]
    rows = [[head, *cells] for head, *cells in zip(HEADS, *lines, strict=True)]
    returns = [
        # Evaluations where there are any, else training episodes.
        next(filter(None, (numbers(metric_rows(folder), metric) for metric in RETURN)), [])
        for folder in folders
    ]
    rows.append(["best return", *(written(max(values, default=None), ".4g") for values in returns)])
    fields = dict.fromkeys(name for config in configs for name in config)
    differing = []
    for name in fields:
        values = [config.get(name, "-") for config in configs]
        # Fields that are equal in all runs say nothing.
        if len(set(values)) > 1:
            differing.append([name, *values])
    rows += differing[:MOST_FIELDS]
    if len(differing) > MOST_FIELDS:
        rows.append([f"... and {len(differing) - MOST_FIELDS} more fields", *("" for _ in folders)])
    return rows


@plain_style()
def draw(folders: Sequence[Path], picture: Path) -> None:
    """Draw the curves of runs over each other, into a PNG; a ValueError where none has any."""
    tables = [metric_rows(folder) for folder in folders]
    if not any(tables):
        raise ValueError(f"{', '.join(map(str, folders))}: no {METRICS} with rows to draw")
    FigureCanvasAgg(figure := Figure(figsize=(11, 7.5), layout="constrained"))
    for index, (title, metrics, over) in enumerate(PANELS):
        axes = figure.add_subplot(2, 2, index + 1)
        # Returns of evaluations and of training are not the same, and one evaluation is no curve.
        metric = metrics[-1]
        for candidate in metrics:
            shortest = min(len(numbers(rows, candidate)) for rows in tables)
            if shortest > 1:
                metric = candidate
                break
        for name, rows in zip(names(folders), tables, strict=True):
            # Rows that have both, so that the two lists fit.
            points = [row for row in rows if numbers([row], over) and numbers([row], metric)]
            axes.plot(
                numbers(points, over), numbers(points, metric), label=printable(name), linewidth=1.6
            )
        if title == PANELS[-1][0]:
            # Where iterations overlap, one that waited for a graph to be recorded makes the next one look short.
            speeds = sorted(speed for rows in tables for speed in numbers(rows, metric)) or [1.0]
            # The 97th percentile: single rows may have any speed.
            axes.set_ylim(0.0, 1.2 * speeds[int(0.97 * (len(speeds) - 1))])
        title += f": {metric}" if len(metrics) > 1 else ""
        curves.dress(axes, title, over="time (s)" if over == "seconds" else "env states")
        axes.legend(fontsize=8, frameon=False)
    figure.savefig(picture, dpi=110)


def _config(folder: Path) -> dict[str, str]:
    tree = read_yaml(folder / CONFIG)
    if not isinstance(tree, dict):
        raise ValueError(f"{folder / CONFIG}: expected the config of a run")
    return {printable(name): printable(str(value))[:MOST_LETTERS] for name, value in flat(tree)}
