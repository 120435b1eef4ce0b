"""Draws the learning curves of a run as one picture."""

from pathlib import Path

from ksim_rl.runs.csv_table import STEP, read_table
from ksim_rl.runs.plotting import Axes, EngFormatter, Figure, FigureCanvasAgg, plain_style

# Panels in reading order: title, the metrics drawn in it with their labels.
PANELS: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
    (
        "Return",
        (
            ("episode/return", "training episodes"),
            ("evaluation/return_mean", "evaluation, deterministic"),
        ),
    ),
    ("Episode length (env steps)", (("episode/length", "training episodes"),)),
    ("Value loss", (("loss/value", "value"),)),
    ("Policy loss", (("loss/policy", "policy"),)),
    ("Entropy (nats)", (("loss/entropy", "entropy"),)),
    ("KL divergence of one update", (("update/kl", "KL"),)),
    ("Learning rate", (("update/learning_rate", "learning rate"),)),
    ("Std of the actions", (("policy/std", "std"),)),
    ("Env states per second", (("throughput/env_states_per_s", "speed"),)),
)
_COLORS = ("#3465a4", "#cc5500")
# Inches of a panel, and of the room in it beside its axes; and of the title's line.
WIDTH, HEIGHT = 4.6, 2.9
LEFT, RIGHT, BOTTOM, TOP = 0.8, 0.15, 0.5, 0.35
TITLE = 0.5


@plain_style()
def draw(table: Path, picture: Path, *, title: str, solved_at: float | None = None) -> None:
    """Draw the learning curves of a `metrics.csv` into a PNG, with a line at `solved_at`; ValueError without rows."""
    _, rows = read_table(table)
    # Only panels with data: algorithms log different metrics.
    present = [
        (name, series)
        for name, series in PANELS
        if any(row.get(key) for row in rows for key, _ in series)
    ]
    if not present:
        raise ValueError(f"{table}: no rows to draw")
    columns = min(3, len(present))
    # Rounded up.
    lines = -(-len(present) // columns)
    width = WIDTH * columns
    height = HEIGHT * lines + TITLE
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    # Matplotlib's own layouts find these margins by drawing all twice, in two thirds of the time.
    figure.subplots_adjust(
        left=LEFT / width,
        right=1.0 - RIGHT / width,
        bottom=BOTTOM / height,
        top=1.0 - (TITLE + TOP) / height,
        wspace=(LEFT + RIGHT) / (WIDTH - LEFT - RIGHT),
        hspace=(BOTTOM + TOP) / (HEIGHT - BOTTOM - TOP),
    )
    figure.suptitle(title, fontsize=13, y=1.0 - 0.15 / height, va="top")
    for index, (name, series) in enumerate(present):
        axes = figure.add_subplot(lines, columns, index + 1)
        _draw_panel(axes, rows, name, series, solved_at=solved_at if name == "Return" else None)
    figure.savefig(picture, dpi=110)


def _draw_panel(
    axes: Axes,
    rows: list[dict[str, str]],
    name: str,
    series: tuple[tuple[str, str], ...],
    *,
    solved_at: float | None,
) -> None:
    for (key, label), color in zip(series, _COLORS, strict=False):
        points = [(float(row[STEP]), float(row[key])) for row in rows if row.get(key)]
        if points:
            # Few points are evaluations: they are marked, as a line between them says little.
            marker = "o" if len(points) < 25 else None
            style = {"marker": marker, "markersize": 3, "linewidth": 1.6}
            axes.plot(*zip(*points, strict=True), color=color, label=label, **style)
    # Only in the panel of returns.
    if solved_at is not None:
        axes.axhline(
            solved_at,
            color="#4e9a06",
            linestyle="--",
            linewidth=1.2,
            label=f"solved at {solved_at:g}",
        )
    dress(axes, name)
    if len(axes.lines) > 1:
        axes.legend(fontsize=8, frameon=False)


def dress(axes: Axes, title: str, *, over: str = "env states") -> None:
    """Give a panel its title, the label of its horizontal axis, and a light grid."""
    axes.set_title(title, fontsize=10.5)
    axes.set_xlabel(over, fontsize=9)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
