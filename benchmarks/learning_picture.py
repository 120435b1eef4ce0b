"""The picture of a learning-curve benchmark: all seeds, and a peer's curve where one was measured."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

PANELS = {
    "episode/return": "Return",
    "reward/track_linear_velocity": "Linear velocity tracking (of 2)",
    "reward/track_angular_velocity": "Angular velocity tracking (of 2)",
    "episode/length": "Episode length (env steps)",
    "metric/pose_distance": "Distance from the reference pose (rad)",
    "update/action_error": "Distance from the teacher's actions",
}
# mjlab 1.6.0 with rsl_rl 5.4.2, one H200, 4096 envs, 24-step rollouts: env states, seconds, and the means of panels.
PEER = {
    "go1_velocity_flat": {
        "env_states": (5.0e6, 9.9e6, 14.8e6, 19.8e6, 29.5e6),
        "seconds": (33, 66, 99, 131, 192),
        "reward/track_linear_velocity": (0.69, 0.70, 0.87, 1.09, 1.39),
        "reward/track_angular_velocity": (0.43, 0.89, 1.02, 1.08, 1.20),
    }
}
_COLORS = ("#3465a4", "#4e9a06", "#75507b", "#c4a000")
_PEER_COLOR = "#cc5500"


def draw(
    curves: dict[int, list[dict[str, float]]],
    picture: Path,
    *,
    task_name: str,
    learner: str,
    num_envs: int,
) -> None:
    """Draw each panel over env states, and over seconds below it; `learner` is for the title."""
    rows = next(iter(curves.values()))
    present = [name for name in PANELS if any(name in point for point in rows)]
    figure = Figure(figsize=(3.9 * len(present), 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    seeds = "1 seed" if len(curves) == 1 else f"{len(curves)} seeds"
    figure.suptitle(f"{task_name}, {learner}: {num_envs} envs, {seeds}", fontsize=13)
    for line, (step, label) in enumerate((("env_states", "env states"), ("seconds", "seconds"))):
        for column, name in enumerate(present):
            axes = figure.add_subplot(2, len(present), line * len(present) + column + 1)
            for (seed, points), color in zip(curves.items(), _COLORS * len(curves), strict=False):
                pairs = [(point[step], point[name]) for point in points if name in point]
                axes.plot(
                    *zip(*pairs, strict=True), color=color, linewidth=1.4, label=f"seed {seed}"
                )
            finish_panel(axes, name, task_name=task_name, step=step)
            axes.set_xlabel(label, fontsize=9)
            if column == 1 and line == 0:
                axes.legend(fontsize=8, frameon=False)
    figure.savefig(picture, dpi=100)


def finish_panel(axes: Axes, name: str, *, task_name: str, step: str = "env_states") -> None:
    """Add the peer's curve of a metric, where it was measured, and what all panels over this step look like."""
    peer = PEER.get(task_name, {})
    if name in peer:
        axes.plot(
            peer[step], peer[name], color=_PEER_COLOR, marker="o", markersize=4, linestyle="--",
            label="mjlab 1.6.0 + rsl_rl (H200)",
        )  # fmt: skip
    if step == "env_states":
        axes.set_title(PANELS[name], fontsize=10.5)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
