"""Writes a table: figures as JSON, rows as Markdown, and a picture."""

import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from ksim_rl.config.trees import Tree
from ksim_rl.files.writing import whole_file, write_whole
from ksim_rl.tables.levels import Result, is_reached, value_of
from ksim_rl.tables.table import Row, Table

Results = Sequence[Result]
PROTOCOL = (
    "Settings were fixed before these seeds were run. The final policy is judged, not the best one: deterministic "
    "actions in fresh envs. Seconds are of training, its first iteration included; what is compiled before is apart. A "
    "level holds where the mean over one million env states reaches it, and a seed that never gets there counts as "
    "infinite."
)


def figures_of(table: Table, rows: Mapping[str, Results]) -> dict[str, float]:
    """Return flat figures: `<table>/<row>`, with `/seconds` and `/falls`, or `/success` for these measures; means.

    An infinite value has no figure, and neither has a mean over a group that lacks a row.
    """
    figures = {}
    for name, results in rows.items():
        value = value_of(table.rows[name], results)
        key = f"{table.name}/{name}"
        # The worst seed counts: a gait that falls with one seed is no success.
        if table.rows[name].measure == "seconds":
            figures[f"{key}/falls"] = max(result["falls"] for result in results)
        # The return has the plain name, as most rows measure it.
        key += {"return": ""}.get(table.rows[name].measure, f"/{table.rows[name].measure}")
        if value is not None:
            figures[key] = round(value, 4 if key.endswith("/success") else 2)
    for mean_name, mean in table.means.items():
        found = {}
        for group, names in table.groups().items():
            keys = [
                f"{table.name}/{name}"
                for name in names
                if name.rpartition("/")[2] not in mean.without
            ]
            # Only over whole groups: means over different rows cannot be compared.
            if all(key in figures for key in keys):
                found[group] = round(statistics.fmean(figures[key] for key in keys), 2)
        figures |= {f"{table.name}/{group}/{mean_name}": value for group, value in found.items()}
        if found:
            # The best group shows what the library can do, whatever the algorithm.
            figures[f"{table.name}/best/{mean_name}"] = max(found.values())
    return figures


def write(table: Table, rows: Mapping[str, Results], folder: Path, *, seeds: Sequence[int]) -> Path:
    """Write `<folder>/<table>.json`, `.md` and, where a row is complete, `.png`; return the path of the first."""
    counted = [result for row in rows.values() for result in row]
    # Commit and versions of the newest result stand for the table; all commits are listed.
    newest = max(counted, key=lambda result: result["date"], default={})
    tree = {
        **{key: newest.get(key, "") for key in ("commit", "date", "device", "versions")},
        "command": f"ksim-rl reproduce {table.source}",
        "commits": sorted({result["commit"] for result in counted}),
        "seeds": sorted(
            {s for row in table.rows.values() for s in row.seeds if not seeds or s in seeds}
        ),
        "figures": figures_of(table, rows),
        "seconds_in_all": round(sum(result["seconds"] for result in counted), 1),
        "rows": {
            name: {
                "reached": is_reached(table.rows[name], results),
                "value": value_of(table.rows[name], results),
                "goal": table.rows[name].goal,
                # Curves are for the picture only.
                "runs": [
                    {k: v for k, v in r.items() if k not in ("curve", "versions")} for r in results
                ],
            }
            for name, results in rows.items()
        },
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{table.name}.json"
    # JSON for programs, Markdown for readers.
    write_whole(path, json.dumps(tree, indent=2) + "\n")
    write_whole(path.with_suffix(".md"), _markdown(table, rows, tree))
    if rows:
        from ksim_rl.tables import picture  # Matplotlib takes half a second to import

        with whole_file(path.with_suffix(".png")) as temporary:
            picture.draw(table, rows, temporary)
    return path


def _markdown(table: Table, rows: Mapping[str, Results], tree: Tree) -> str:
    lines = [f"# {table.title}", ""]
    for group, names in table.groups().items():
        # One column for each publication that any row of the group has.
        others = list(dict.fromkeys(key for name in names for key in table.rows[name].published))
        head = [
            group or table.name,
            *others,
            "ours",
            "seeds",
            "env states",
            "seconds + before",
            "reached",
        ]
        lines += [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        for name in names:
            published = [f"{table.rows[name].published.get(other, '-')}" for other in others]
            cells = [
                name.rpartition("/")[2],
                *published,
                *_cells(table.rows[name], rows.get(name, ())),
            ]
            lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    for key, value in tree["figures"].items():
        group, _, name = key.removeprefix(f"{table.name}/").rpartition("/")
        if name in table.means:
            goal = table.means[name].at_least.get(group)
            lines.append(
                f"* {group}, {name}: {value:.0f}" + (f", at least {goal:g} asked" if goal else "")
            )
    where = ", ".join(sorted({result["device"] for results in rows.values() for result in results}))
    what = (
        f"{len(rows)} of {len(table.rows)} rows, {tree['seconds_in_all']:,.0f} s of training in all"
    )
    lines += [
        "",
        PROTOCOL,
        "",
        table.notes,
        "",
        f"{what}; {where}; commits {', '.join(tree['commits'])}",
    ]
    return "\n".join(lines) + "\n"


def _cells(row: Row, results: Results) -> list[str]:
    if not results:
        return ["", "0", "", "", "not run"]
    value = value_of(row, results)
    # The spread over seeds, of the same evaluations as the value.
    returns = [r["evaluation"]["return_mean"] for r in results]
    if len(returns) > 1:
        spread = f" ± {statistics.stdev(returns):.0f}"
    else:
        spread = ""
    if value is None:
        ours = ""
    else:
        ours = f"{value:.0f}{spread}"
    # With returns the levels are a second condition, whose worst seed is shown.
    for level in row.levels if row.measure == "return" else ():
        worst = min(r["means"].get(level, float("-inf")) for r in results)
        ours += f", {level.rpartition('/')[2]} {worst:.2f}"
    if row.measure == "seconds":
        falls = f"falls {100 * max(result['falls'] for result in results):.1f} %"
        ours = f"{'not reached' if value is None else f'{value:.1f} s'}, {falls}"
    elif row.measure == "success" and value is not None:
        ours = f"{100 * value:.1f} % of trials succeed"
    states = statistics.fmean(result["env_states"] for result in results)
    seconds = statistics.fmean(result["seconds"] for result in results)
    before = statistics.fmean(result["seconds_before"] for result in results)
    verdict = {True: "yes", False: "no", None: ""}[is_reached(row, results)]
    return [
        ours,
        str(len(results)),
        f"{states / 1e6:.1f} M",
        f"{seconds:.0f} + {before:.0f}",
        verdict,
    ]
