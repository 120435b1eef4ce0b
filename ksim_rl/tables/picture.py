"""Draws a table: each row's seeds and their summary, beside published figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap

from ksim_rl.runs.plotting import Figure, FigureCanvasAgg, plain_style
from ksim_rl.tables.levels import Result, value_of
from ksim_rl.tables.table import Table

OURS = "#3465a4"
# Marker and colour of each publication.
OTHERS = (("D", "#cc5500"), ("s", "#75507b"), ("^", "#4e9a06"), ("v", "#c4a000"))


@plain_style()
def draw(table: Table, rows: Mapping[str, Sequence[Result]], path: Path) -> None:
    """Draw one panel per group; `rows` has the results of those rows that are complete."""
    groups = []
    for group, names in table.groups().items():
        complete = [name for name in names if name in rows]
        if complete:
            groups.append((group, complete))
    # Rows of panels, rounded up.
    down = -(-len(groups) // 3)
    across = min(len(groups), 3)
    # The panel with the most rows gives the height of all.
    most = max(len(names) for _, names in groups)
    figure = Figure(figsize=(6.0 * across, (1.8 + 0.27 * most) * down), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle("\n".join(wrap(table.title, 60 * across)), fontsize=12)
    for place, (group, names) in enumerate(groups):
        axes = figure.add_subplot(down, across, place + 1)
        for line, name in enumerate(names):
            # Each seed is a dot, their summary a line.
            for result in (*[[one] for one in rows[name]], rows[name]):
                if (value := value_of(table.rows[name], result)) is not None:
                    axes.plot(
                        [value], [line], "|" if result is rows[name] else ".", color=OURS, ms=12
                    )
        # Each publication keeps its marker and colour within a panel.
        others = list(dict.fromkeys(key for name in names for key in table.rows[name].published))
        for other, (marker, color) in zip(others, OTHERS, strict=False):
            pairs = [(table.rows[n].published.get(other), line) for line, n in enumerate(names)]
            values, lines = zip(*((v, line) for v, line in pairs if v is not None), strict=True)
            axes.plot(values, lines, marker, color=color, ms=4, label=other)
        # An empty plot, for the legend.
        axes.plot([], [], "|", color=OURS, label="ours, and its seeds")
        axes.set_yticks(range(len(names)), [name.rpartition("/")[2] for name in names], fontsize=8)
        # The first row on top.
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlim(left=0.0)
        axes.set_xlabel(table.rows[names[0]].measure, fontsize=9)
        axes.set_title(group or table.name, fontsize=10.5)
        axes.grid(alpha=0.25)
        axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=100)
