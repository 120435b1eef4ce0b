"""Times training, and the raw physics inside of it, with more and more envs.

    python -m benchmarks.scaling task=go1_velocity_flat num_envs=1024,2048,4096,8192,16384,32768 device=cuda

takes the overrides of `ksim-rl train`; each number of envs is a run of `benchmarks.throughput` in a process of its own,
with rollouts of the same length and as many minibatches. Figures go to benchmarks/results/scaling.json:
`<device>/<task>/<num_envs>/env_states_per_s` and `physics_env_states_per_s`, and
`<device>/<task>/growth_4096_to_32768`. The chart beside it also shows the figure that the peer reached with its own
training of this task (`PUBLISHED`).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report

NUM_ENVS = "1024,2048,4096,8192,16384,32768"
PER_MINIBATCH = "data.num_env_states_per_minibatch="
SMALL, LARGE = 4096, 32768
# mjlab 1.6.0 with rsl_rl 5.4.2 on one H200 (env states/s, training, 4096 envs).
PUBLISHED = {"go1_velocity_flat": 0.160e6, "g1_velocity_flat": 0.153e6}
OWN = ("env_states_per_s", "physics_env_states_per_s", "iteration_over_physics")


def measure(words: list[str], num_envs: int) -> dict[str, float]:
    """Run `benchmarks.throughput` with so many envs and return its figures."""
    cfg = command_line.compose([*words, "logger=none"])
    length = cfg.data.rollout_length(cfg.num_envs)
    per_minibatch = length * num_envs // cfg.data.num_minibatches
    with tempfile.TemporaryDirectory() as folder:
        kept = [word for word in words if not word.startswith(PER_MINIBATCH)]
        sizes = [f"num_envs={num_envs}", f"{PER_MINIBATCH}{per_minibatch}"]
        command = [sys.executable, "-m", "benchmarks.throughput", *kept, *sizes]
        environment = os.environ | {"BENCHMARK_RESULTS": folder}
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
        figures = json.loads((Path(folder) / "throughput.json").read_text())["figures"]
    found = {name.rpartition("/")[2]: value for name, value in figures.items()}
    found["physics_env_states_per_s"] = 1000.0 * num_envs / found["physics_ms"]
    return {name: found[name] for name in OWN}


def growth(figures: dict[int, dict[str, float]]) -> dict[str, float]:
    """Return how much faster training is with the most envs than with 4096, under the name that says so."""
    if SMALL not in figures or LARGE not in figures:
        return {}
    ratio = figures[LARGE]["env_states_per_s"] / figures[SMALL]["env_states_per_s"]
    return {f"growth_{SMALL}_to_{LARGE}": ratio}


def draw(figures: dict[int, dict[str, float]], path: Path, *, task_name: str, device: str) -> str:
    """Draw training and raw physics over the number of envs, and the peer's published figure where there is one.

    A single number of envs makes no curve, and leaves the chart of an earlier run as it is. Returned is what was done.
    """
    if len(figures) < 2:
        return f"{path} is left as it is: a chart takes two numbers of envs"
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    sizes = sorted(figures)
    lines = (
        ("ksim_rl, training", "env_states_per_s", "o-", "#1f77b4"),
        ("MuJoCo Warp, physics alone", "physics_env_states_per_s", "s--", "#7f7f7f"),
    )
    for label, name, style, color in lines:
        values = [figures[size][name] / 1e6 for size in sizes]
        axes.plot(sizes, values, style, color=color, label=label)
    if task_name in PUBLISHED:
        axes.plot(
            [SMALL],
            [PUBLISHED[task_name] / 1e6],
            "D",
            color="#d62728",
            label="mjlab 1.6.0 + rsl_rl, training (published, H200)",
        )
    axes.set(
        xscale="log",
        xlabel="envs",
        ylabel="million env states per second",
        title=f"{task_name} on {device}",
    )
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.minorticks_off()
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=9, loc="upper left")
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return f"drawn in {path}"


def main() -> None:
    """Measure all sizes and print them, keep the figures of each as it is done, and draw the chart."""
    own, words = command_line.split(sys.argv[1:], {"num_envs": NUM_ENVS})
    sizes = command_line.whole_numbers("num_envs", own["num_envs"])
    cfg = command_line.compose([*words, "logger=none"])
    device = cfg.resolved_device()
    prefix, figures = f"{report.device_label(device)}/{cfg.task_name}", {}
    for size in sizes:
        figures[size] = measure(words, size)
        flat = {f"{size}/{name}": value for name, value in figures[size].items()} | growth(figures)
        path = report.write(
            "scaling",
            figures={f"{prefix}/{name}": round(value, 4) for name, value in flat.items()},
            device=device,
            module="benchmarks.scaling",
        )
        print(
            f"{size} envs: {figures[size]['env_states_per_s']:,.0f} env states/s, written to {path}",
            flush=True,
        )
    Console().print(_table(figures, f"{cfg.task_name}, {report.device_name(device)}"))
    chart = report.RESULTS / f"scaling_{cfg.task_name}.png"
    print(draw(figures, chart, task_name=cfg.task_name, device=report.device_name(device)))


def _table(figures: dict[int, dict[str, float]], title: str) -> Table:
    table = Table(
        title=title,
        caption=" ".join(f"{name} {value:.2f}" for name, value in growth(figures).items()),
    )
    for column in (
        "envs",
        "training, env states/s",
        "raw physics, env states/s",
        "relative to physics",
    ):
        table.add_column(column, justify="right")
    for size, row in figures.items():
        speeds = (f"{row[name]:,.0f}" for name in ("env_states_per_s", "physics_env_states_per_s"))
        table.add_row(str(size), *speeds, f"{row['iteration_over_physics']:.3f}")
    return table


if __name__ == "__main__":
    command_line.run(main)
