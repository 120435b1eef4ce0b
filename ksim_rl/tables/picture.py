"""Draws a table: each row's seeds and their summary, beside published figures."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap

from ksim_rl.runs.plotting import Axes, Figure, FigureCanvasAgg, plain_style
from ksim_rl.tables.levels import Result, value_of
from ksim_rl.tables.table import Table

OURS = "#3465a4"
# Marker and colour of each publication.
OTHERS = (("D", "#cc5500"), ("s", "#75507b"), ("^", "#4e9a06"), ("v", "#c4a000"))


PANELS_ACROSS = 3
PANEL_WIDTH = 6.0
# Heights in inches: of what stands around the rows of a panel, and of one row.
PANEL_FRAME = 1.8
ROW_HEIGHT = 0.27


@plain_style()
def draw(table: Table, rows: Mapping[str, Sequence[Result]], path: Path) -> None:
    """Draw one panel per group; `rows` has the results of those rows that are complete."""
    groups = _complete_groups(table, rows)
    down = math.ceil(len(groups) / PANELS_ACROSS)
    across = min(len(groups), PANELS_ACROSS)
    # The panel with the most rows gives the height of all.
    most = max(len(names) for names in groups.values())
    height = PANEL_FRAME + ROW_HEIGHT * most
    figure = Figure(figsize=(PANEL_WIDTH * across, height * down), layout="constrained")
    FigureCanvasAgg(figure)
    title = wrap(table.title, 60 * across)
    figure.suptitle("\n".join(title), fontsize=12)
    for place, (group, names) in enumerate(groups.items()):
        axes = figure.add_subplot(down, across, place + 1)
        _draw_ours(axes, table, names, rows)
        _draw_published(axes, table, names)
        axes.set_yticks(range(len(names)))
        axes.set_yticklabels([name.rpartition("/")[2] for name in names], fontsize=8)
        # The first row on top.
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlim(left=0.0)
        axes.set_xlabel(table.rows[names[0]].measure, fontsize=9)
        axes.set_title(group or table.name, fontsize=10.5)
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=100)


def _complete_groups(table: Table, rows: Mapping[str, Sequence[Result]]) -> dict[str, list[str]]:
    """Return the names of complete rows by group, without groups that have none."""
    groups = {}
    for group, names in table.groups().items():
        complete = [name for name in names if name in rows]
        if complete:
            groups[group] = complete
    return groups


def _draw_ours(
    axes: Axes, table: Table, names: Sequence[str], rows: Mapping[str, Sequence[Result]]
) -> None:
    """Draw a line of each row: a dot for each seed, and a stroke for their summary."""
    for line, name in enumerate(names):
        for result in rows[name]:
            value = value_of(table.rows[name], [result])
            if value is not None:
                axes.plot([value], [line], ".", color=OURS, ms=12)
        summary = value_of(table.rows[name], rows[name])
        if summary is not None:
            axes.plot([summary], [line], "|", color=OURS, ms=12)
    # An empty plot, for the legend.
    axes.plot([], [], "|", color=OURS, label="ours, and its seeds")


def _draw_published(axes: Axes, table: Table, names: Sequence[str]) -> None:
    """Draw published figures; each publication keeps its marker and colour within a panel."""
    publications: dict[str, None] = {}
    for name in names:
        publications |= dict.fromkeys(table.rows[name].published)
    for publication, (marker, color) in zip(publications, OTHERS, strict=False):
        values = []
        lines = []
        for line, name in enumerate(names):
            value = table.rows[name].published.get(publication)
            if value is not None:
                values.append(value)
                lines.append(line)
        axes.plot(values, lines, marker, color=color, ms=4, label=publication)
