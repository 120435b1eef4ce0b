"""Finds when a learning curve reaches levels, and whether several seeds do so together."""

import math
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence

from ksim_rl.config.trees import Tree
from ksim_rl.tables.table import COURSE_LEAST, Row

HELD_STATES = 1e6
# Words of names whose figures should be small.
OF_ERRORS = {
    "acceleration",
    "cost",
    "distance",
    "drift",
    "error",
    "errors",
    "fall",
    "fallen",
    "falls",
    "fell",
    "force",
    "loss",
    "mpjpe",
    "mpkpe",
    "penetration",
    "power",
    "seconds",
    "slip",
    "termination",
    "torque",
    "violation",
}
Point = Mapping[str, float]
# What `measure` found for a seed of a row, as plain data.
Result = Tree


def less_is_better(name: str) -> bool:
    """Return whether a figure of this name is an error, told by the words of the name; of all others more is better.

    So `metric/pose_distance` is one, and `termination/fell`, and `metric/success` is none.
    """
    words = re.split(r"[/_ ]", name.lower())
    # A reward is one even of an error, and who reaches the end of the time has not failed.
    if name.startswith("reward/") or name.endswith("time_out"):
        return False
    return not OF_ERRORS.isdisjoint(words)


def worst(name: str, values: Iterable[float]) -> float:
    """Return the worst of several seeds' values of a figure."""
    if less_is_better(name):
        return max(values)
    return min(values)


def holds(name: str, value: float | None, level: float) -> bool:
    """Return whether a value is as good as a level, or better; a seed without one has it not."""
    if value is None:
        return False
    if less_is_better(name):
        return value <= level
    return value >= level


def means_of(points: Sequence[Point], names: Iterable[str]) -> dict[str, float]:
    """Return the means of metrics; one that a point lacks, as no episode ended then, counts in no mean."""
    means = {}
    for name in names:
        values = [point[name] for point in points if name in point]
        if values:
            means[name] = statistics.fmean(values)
    return means


def reached(points: Sequence[Point], levels: Mapping[str, float]) -> Point | None:
    """Return the end of the first `HELD_STATES` env states over which all levels hold in the mean; None: never."""
    for index, point in enumerate(points):
        # Too little is left of the run to hold the levels over.
        if points[-1]["env_states"] < point["env_states"] + HELD_STATES:
            return None
        # From this point on, for as many env states as have to be held.
        held = [
            other
            for other in points[index:]
            if other["env_states"] <= point["env_states"] + HELD_STATES
        ]
        means = means_of(held, levels)
        if all(holds(name, means.get(name), level) for name, level in levels.items()):
            return held[-1]
    return None


def value_of(row: Row, results: Sequence[Result]) -> float | None:
    """Return the figure of all seeds: a mean return, a median of seconds (None is infinite), or a lowest share."""
    if row.measure == "return":
        return statistics.fmean(result["evaluation"]["return_mean"] for result in results)
    # The worst seed counts.
    if row.measure == "success":
        return min(result["trials"]["success"] for result in results)
    seconds = []
    for result in results:
        value = result["seconds_to_levels"]
        # A seed that never came there is slower than all others.
        seconds.append(math.inf if value is None else value)
    middle = statistics.median(seconds)
    if math.isfinite(middle):
        return middle
    return None


def further_figures(row: Row, results: Sequence[Result]) -> dict[str, float]:
    """Return `Row.figures` of all seeds: seconds are a median, and of all else the worst seed counts.

    A mean that a seed lacks, as no episode ended there, gives no figure.
    """
    figures = {}
    for name, source in row.figures.items():
        if source == "seconds":
            figures[name] = statistics.median(result["seconds"] for result in results)
        elif source == "success":
            figures[name] = min(result["trials"]["success"] for result in results)
        elif all(source in result["means"] for result in results):
            figures[name] = worst(source, [result["means"][source] for result in results])
    return figures


def falls_of(row: Row, results: Sequence[Result]) -> float:
    """Return the share of falls of the worst seed: on the course where the row has one, else in the last evaluation."""
    if row.course_level is not None:
        return max(result["course"]["fell"] for result in results)
    return max(result["falls"] for result in results)


def course_least_of(results: Sequence[Result]) -> float:
    """Return the least share of robots that cross a kind of ground at the row's level, of all kinds and seeds."""
    return min(result["means"][COURSE_LEAST] for result in results)


def lost_worlds_of(results: Sequence[Result]) -> int:
    """Return in how many worlds of the final evaluations, trials and courses contacts or constraints were lost."""
    total = 0
    for result in results:
        for name in ("evaluation", "trials", "course"):
            part = result.get(name) or {}
            # Courses of before have lines alone.
            total += part.get("lost_worlds", len(part.get("lost", ())))
    return total


def is_reached(row: Row, results: Sequence[Result]) -> bool | None:
    """Return whether a row reaches all its goals; None where it has none and its evaluations lost nothing.

    Where an evaluation has lost contacts or constraints nothing is reached, goals or not: its figures are of other
    physics.
    """
    if lost_worlds_of(results):
        return False
    value = value_of(row, results)
    found = []
    if row.goal is not None:
        # Seconds should be few, returns and shares many.
        is_good = value is not None and (
            value <= row.goal if row.measure == "seconds" else value >= row.goal
        )
        found.append(is_good)
    # With seconds the levels are the measure itself; else each seed has to have them.
    for name, level in row.levels.items() if row.measure != "seconds" else ():
        found += [holds(name, result["means"].get(name), level) for result in results]
    if row.most_falls is not None:
        found.append(falls_of(row, results) < row.most_falls)
    if row.course_least is not None:
        found.append(course_least_of(results) >= row.course_least)
    if found:
        return all(found)
    return None
