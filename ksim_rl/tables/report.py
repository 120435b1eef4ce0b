"""Writes a table: figures as JSON, rows as Markdown, and a picture."""

import json
import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from ksim_rl.config.trees import Tree
from ksim_rl.files.writing import whole_file, write_whole
from ksim_rl.tables.levels import (
    Result,
    course_least_of,
    falls_of,
    further_figures,
    is_reached,
    less_is_better,
    lost_worlds_of,
    value_of,
    worst,
)
from ksim_rl.tables.lineage import lineage_figures
from ksim_rl.tables.table import Row, Table

Results = Sequence[Result]
PROTOCOL = (
    "Settings were fixed before these seeds were run. The final policy is judged, not the best one: deterministic "
    "actions in fresh envs. Seconds are of training, its first iteration included; what is compiled before is apart. A "
    "level holds where the mean over one million env states reaches it, and a seed that never gets there counts as "
    "infinite."
)
# Columns of the Markdown tables, behind those with the names and the published figures.
COLUMNS = ("ours", "seeds", "env states", "seconds + before", "reached")


def figures_of(table: Table, rows: Mapping[str, Results]) -> dict[str, float]:
    """Return flat figures: `<table>/<row>`, with `/seconds` and `/falls`, or `/success` for these measures; means.

    Each row also has its `Row.figures`, and rows that learn from others the figures of `lineage_figures`. An infinite
    value has no figure, and neither has a mean over a group that lacks a row.
    """
    figures: dict[str, float] = {}
    for name, results in rows.items():
        figures |= _row_figures(table, name, results)
    for mean_name, mean in table.means.items():
        figures |= _mean_figures(table, mean_name, mean.without, figures)
    for name, value in lineage_figures(table.rows, rows).items():
        figures[f"{table.name}/{name}"] = value
    return figures


def _row_figures(table: Table, name: str, results: Results) -> dict[str, float]:
    row = table.rows[name]
    value = value_of(row, results)
    key = f"{table.name}/{name}"
    figures = {}
    if row.measure == "seconds":
        # The worst seed counts: a gait that falls with one seed is no success.
        figures[f"{key}/falls"] = falls_of(row, results)
    # The return has the plain name, as most rows measure it.
    if row.measure != "return":
        key += f"/{row.measure}"
    if value is not None:
        digits = 4 if row.measure == "success" else 2
        figures[key] = round(value, digits)
    for further_name, further in further_figures(row, results).items():
        figures[f"{table.name}/{name}/{further_name}"] = round(further, 4)
    return figures


def _mean_figures(
    table: Table, mean_name: str, without: Collection[str], figures: Mapping[str, float]
) -> dict[str, float]:
    """Return the mean of each group whose rows all have a figure, and the best of these means."""
    means = {}
    for group, names in table.groups().items():
        counted = [name for name in names if name.rpartition("/")[2] not in without]
        keys = [f"{table.name}/{name}" for name in counted]
        # Only over whole groups: means over different rows cannot be compared.
        if all(key in figures for key in keys):
            mean = statistics.fmean(figures[key] for key in keys)
            means[f"{table.name}/{group}/{mean_name}"] = round(mean, 2)
    if means:
        # The best group shows what the library can do, whatever the algorithm.
        means[f"{table.name}/best/{mean_name}"] = max(means.values())
    return means


def write(table: Table, rows: Mapping[str, Results], folder: Path, *, seeds: Sequence[int]) -> Path:
    """Write `<folder>/<table>.json`, `.md` and, where a row has a figure, `.png`; return the path of the first."""
    tree = _tree(table, rows, seeds)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{table.name}.json"
    # JSON for programs, Markdown for readers.
    write_whole(path, json.dumps(tree, indent=2) + "\n")
    write_whole(path.with_suffix(".md"), _markdown(table, rows, tree))
    # A level that no seed reaches has no place on an axis of seconds.
    drawn = {
        name: results
        for name, results in rows.items()
        if value_of(table.rows[name], results) is not None
    }
    if drawn:
        from ksim_rl.tables import picture  # Matplotlib takes half a second to import

        with whole_file(path.with_suffix(".png")) as temporary:
            picture.draw(table, drawn, temporary)
    else:
        # The picture of figures that no longer count.
        path.with_suffix(".png").unlink(missing_ok=True)
    return path


def _tree(table: Table, rows: Mapping[str, Results], seeds: Sequence[int]) -> Tree:
    """Return the content of the JSON file; `seeds` are the ones that were asked for, none for all of the table."""
    counted = _all_results(rows)
    # Commit and versions of the newest result stand for the table; all commits are listed.
    newest = max(counted, key=lambda result: result["date"], default={})
    seeds_of_table = {seed for row in table.rows.values() for seed in row.seeds}
    if seeds:
        seeds_of_table &= set(seeds)
    return {
        "commit": newest.get("commit", ""),
        "date": newest.get("date", ""),
        "device": newest.get("device", ""),
        "versions": newest.get("versions", ""),
        "command": f"ksim-rl reproduce {table.source}",
        "commits": _distinct(counted, "commit"),
        "seeds": sorted(seeds_of_table),
        "figures": figures_of(table, rows),
        "seconds_in_all": round(sum(result["seconds"] for result in counted), 1),
        "rows": {name: _row_tree(table.rows[name], results) for name, results in rows.items()},
    }


def _row_tree(row: Row, results: Results) -> Tree:
    runs = []
    for result in results:
        # Curves are for the picture only.
        runs.append({k: v for k, v in result.items() if k not in ("curve", "versions")})
    return {
        "reached": is_reached(row, results),
        "value": value_of(row, results),
        "goal": row.goal,
        "runs": runs,
    }


def _all_results(rows: Mapping[str, Results]) -> list[Result]:
    return [result for results in rows.values() for result in results]


def _distinct(results: Results, key: str) -> list[str]:
    return sorted({result[key] for result in results})


def _markdown(table: Table, rows: Mapping[str, Results], tree: Tree) -> str:
    lines = [f"# {table.title}", ""]
    for group, names in table.groups().items():
        lines += _group_lines(table, group, names, rows)
        lines.append("")
    for key, value in tree["figures"].items():
        group, _, name = key.removeprefix(f"{table.name}/").rpartition("/")
        if name in table.means:
            lines.append(_mean_line(table, group, name, value))
    counted = _all_results(rows)
    rows_run = f"{len(rows)} of {len(table.rows)} rows"
    seconds = f"{tree['seconds_in_all']:,.0f} s of training in all"
    devices = ", ".join(_distinct(counted, "device"))
    commits = ", ".join(tree["commits"])
    conditions = f"{rows_run}, {seconds}; {devices}; commits {commits}"
    lines += ["", PROTOCOL, "", table.notes, "", conditions]
    return "\n".join(lines) + "\n"


def _group_lines(
    table: Table, group: str, names: Sequence[str], rows: Mapping[str, Results]
) -> list[str]:
    """Return the Markdown table of a group, with a column for each publication that any of its rows has."""
    publications: dict[str, None] = {}
    for name in names:
        publications |= dict.fromkeys(table.rows[name].published)
    head = [group or table.name, *publications, *COLUMNS]
    lines = [_table_line(head), "|" + "---|" * len(head)]
    for name in names:
        row = table.rows[name]
        published = [str(row.published.get(other, "-")) for other in publications]
        own = _cells(row, rows.get(name, ()))
        lines.append(_table_line([name.rpartition("/")[2], *published, *own]))
    return lines


def _table_line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _mean_line(table: Table, group: str, name: str, value: float) -> str:
    line = f"* {group}, {name}: {value:.0f}"
    goal = table.means[name].at_least.get(group)
    if goal:
        line += f", at least {goal:g} asked"
    return line


def _cells(row: Row, results: Results) -> list[str]:
    """Return the cells of a row below `COLUMNS`."""
    if not results:
        return ["", "0", "", "", "not run"]
    states = statistics.fmean(result["env_states"] for result in results)
    seconds = statistics.fmean(result["seconds"] for result in results)
    before = statistics.fmean(result["seconds_before"] for result in results)
    verdict = {True: "yes", False: "no", None: ""}[is_reached(row, results)]
    return [
        _our_cell(row, results),
        str(len(results)),
        f"{states / 1e6:.1f} M",
        f"{seconds:.0f} + {before:.0f}",
        verdict,
    ]


def _our_cell(row: Row, results: Results) -> str:
    """Return the value of a row, and its further figures, but for those that the cell or another one has."""
    cell = _measured(row, results)
    if lost := lost_worlds_of(results):
        cell += f", contacts lost in {lost} worlds"
    for name, value in further_figures(row, results).items():
        if row.figures[name] not in ("seconds", "success"):
            cell += f", {name} {value:.3f}"
    return cell


def _measured(row: Row, results: Results) -> str:
    """Return the value of a row as its measure is read: seconds and falls, trials, or a return with its spread."""
    value = value_of(row, results)
    if row.measure == "seconds":
        seconds = "not reached" if value is None else f"{value:.1f} s"
        cell = f"{seconds}, falls {100 * falls_of(row, results):.1f} %"
        if row.course_level is not None:
            least = course_least_of(results)
            cell += f", at least {100 * least:.0f} % cross level {row.course_level}"
        return cell
    if row.measure == "success" and value is not None:
        return f"{100 * value:.1f} % of trials succeed"
    cell = ""
    if value is not None:
        cell = f"{value:.0f}"
        # The spread over seeds, of the same evaluations as the value.
        returns = [result["evaluation"]["return_mean"] for result in results]
        if len(returns) > 1:
            cell += f" ± {statistics.stdev(returns):.0f}"
    if row.measure == "return":
        # Levels are a second condition, whose worst seed is shown.
        for level in row.levels:
            absent = math.inf if less_is_better(level) else -math.inf
            of_seeds = [result["means"].get(level, absent) for result in results]
            cell += f", {level.rpartition('/')[2]} {worst(level, of_seeds):.2f}"
    return cell
