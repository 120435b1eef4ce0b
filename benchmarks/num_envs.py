"""Does the number of envs matter to learning, where the dataset of an update stays as large?

    python -m benchmarks.num_envs device=cpu

trains a cartpole with 64, 256 and 1024 envs and D = 65536 env states per update (so T = 1024, 256 and 64), five seeds
each (`num_envs=64,256,1024 seeds=1,2,3,4,5`), `at_once=1` of them, and compares the curves of deterministic evaluation
over env states. Other words are overrides of `ksim-rl train`. Figures go to benchmarks/results/num_envs.json, the
picture beside it.

A run's score is its mean evaluation return over all evaluations (the area under its curve). If num_envs did not
matter, the three scores of one seed, which begin with the same networks, could change places. So the test counts in
which share of all such exchanges, or of many drawn ones, the means of the settings lie at least as far apart as they
do: its p-value. How far apart they can be at most is the upper end of an interval of 95 % for the difference of the
two settings that are farthest apart, seed by seed.

Equal in expectation are the sizes. What the first datasets hold is not quite the same: few envs fill them with few
episodes, and where T is shorter than the horizon of the returns, 1 / (1 - gamma), most of what an untrained critic is
asked for lies beyond the end of a rollout. So this setting has a short horizon, spread starts, and steps that a
divergence bounds. Seeds 1 to 5 alone, on a CPU, once had p = 0.02; of 24 seeds it is 0.31.
"""

from __future__ import annotations

import itertools
import multiprocessing
import random
import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from ksim_rl.data import DatasetCfg
from ksim_rl.runs.csv_table import read_table
from ksim_rl.trainers import RunCfg, RunProgress, run

OWN_OPTIONS = {"num_envs": "64,256,1024", "seeds": "1,2,3,4,5", "at_once": "1"}
# Where there are more exchanges than this, so many are drawn.
EXCHANGES = 20_000
SETTING = (
    "task=cartpole_balance",
    "data.num_env_states_per_minibatch=16384",
    "data.num_minibatches=4",
    # So that the datasets are alike from the start; see above.
    "objective.gamma=0.95",
    "objective.schedule=adaptive",
    "task.events.reset.angle_range=0.3",
    "task.events.reset.cart_range=1.0",
    "task.episode_length_s=3.0",
    "trainer.num_iterations=24",
    "trainer.eval_interval=3",
    "trainer.eval_episodes=32",
    "trainer.stop_when_solved=false",
    "trainer.checkpoint_interval=0",
    "trainer.video=false",
    "trainer.num_threads=1",
    "logger.tensorboard=false",
)
_COLORS = ("#3465a4", "#4e9a06", "#cc5500")

Curve = list[tuple[float, float]]


def main() -> None:
    """Train all runs, print and write what they show."""
    own, words = command_line.split(sys.argv[1:], OWN_OPTIONS)
    overrides = [*SETTING, *words]
    seeds = command_line.whole_numbers("seeds", own["seeds"], least=0)
    if len(seeds) < 2:
        raise ValueError(f"seeds={own['seeds']}: expected two or more, for their deviation")
    cfgs = {
        num_envs: [
            command_line.compose([*overrides, f"num_envs={num_envs}", f"seed={seed}"])
            for seed in seeds
        ]
        for num_envs in command_line.whole_numbers("num_envs", own["num_envs"])
    }
    # One after another, too, are in a process of their own: this one holds no GPU.
    at_once = command_line.whole_number("at_once", own["at_once"])
    with ProcessPoolExecutor(at_once, multiprocessing.get_context("spawn")) as pool:
        begun = {
            num_envs: [pool.submit(learning_curve, cfg) for cfg in found]
            for num_envs, found in cfgs.items()
        }
        curves = {
            num_envs: [future.result() for future in found] for num_envs, found in begun.items()
        }
    cfg = next(iter(cfgs.values()))[0]
    scores = {num_envs: [score(curve) for curve in found] for num_envs, found in curves.items()}
    figures = compare(scores)
    device = cfg.resolved_device()
    label = f"{report.device_label(device)}/{cfg.task_name}"
    Console(width=160).print(_table(label, scores, figures))
    path = report.write(
        "num_envs",
        figures={f"{label}/{name}": value for name, value in figures.items()},
        device=device,
        module="benchmarks.num_envs",
        scores={
            str(num_envs): [round(value, 3) for value in found]
            for num_envs, found in scores.items()
        },
    )
    draw(curves, path.with_suffix(".png"), title=_title(cfg, len(seeds), figures))
    print(f"written to {path}")


def learning_curve(cfg: RunCfg) -> Curve:
    """Train, and return the evaluations: (env states, return)."""
    with tempfile.TemporaryDirectory() as folder:
        run(cfg, Path(folder), progress=RunProgress(cfg.trainer.num_iterations, enabled=False))
        _, rows = read_table(Path(folder) / "metrics.csv")
    name = "evaluation/return_mean"
    curve = [(float(row["env_states"]), float(row[name])) for row in rows if row.get(name)]
    print(f"{cfg.num_envs} envs, seed {cfg.seed}: {score(curve):.1f}", flush=True)
    return curve


def score(curve: Curve) -> float:
    """Return the mean evaluation return of a run."""
    return statistics.fmean(value for _, value in curve)


def compare(scores: dict[int, list[float]]) -> dict[str, float]:
    """Compare settings (num_envs -> a score for each seed) by exchanging scores within seeds.

    Returns:
        The mean and the standard deviation over seeds of each setting; `largest_difference` of two means and its
        `largest_difference_at_most`, both also in standard deviations of seeds (pooled over the settings); and the
        test's `p_value`.
    """
    by_seed = list(zip(*scores.values(), strict=True))
    observed = _spread(by_seed)
    exchanged = [_spread(rows) for rows in exchanges(by_seed)]
    as_far = sum(value >= observed * (1.0 - 1e-9) for value in exchanged)
    low, high = (choose(scores.values(), key=statistics.fmean) for choose in (min, max))
    apart = [above - below for below, above in zip(low, high, strict=True)]
    difference = statistics.fmean(apart)
    # Of the normal distribution: Student's with as many seeds as bound a difference well is nearly that.
    at_most = difference + 1.96 * statistics.stdev(apart) / len(apart) ** 0.5
    deviation = statistics.fmean(statistics.variance(found) for found in scores.values()) ** 0.5
    figures = {
        "seeds": len(by_seed),
        "largest_difference": difference,
        "largest_difference_at_most": at_most,
        "seed_deviation": deviation,
        "difference_in_deviations": difference / deviation if deviation else 0.0,
        "at_most_in_deviations": at_most / deviation if deviation else 0.0,
        "p_value": as_far / len(exchanged),
    }
    for num_envs, found in scores.items():
        figures |= {
            f"{num_envs}_envs/mean": statistics.fmean(found),
            f"{num_envs}_envs/std": statistics.stdev(found),
        }
    return {name: round(value, 4) for name, value in figures.items()}


def exchanges(by_seed: Sequence[tuple[float, ...]]) -> Iterator[Sequence[tuple[float, ...]]]:
    """Return all exchanges of scores within seeds, or the given order and many drawn ones where they are too many."""
    ways = [list(itertools.permutations(row)) for row in by_seed]
    if len(ways[0]) ** len(ways) <= EXCHANGES:
        yield from itertools.product(*ways)
        return
    draw = random.Random(0)
    yield by_seed
    for _ in range(EXCHANGES - 1):
        yield [draw.choice(row) for row in ways]


def _spread(rows) -> float:
    """Return the variance of the settings' means; a row holds the scores of one seed."""
    return statistics.pvariance([statistics.fmean(column) for column in zip(*rows, strict=True)])


def draw(curves: dict[int, list[Curve]], picture: Path, *, title: str) -> None:
    """Draw each setting's mean with the range of its seeds, over env states."""
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for (num_envs, found), color in zip(curves.items(), itertools.cycle(_COLORS), strict=False):
        steps = [step for step, _ in found[0]]
        columns = list(zip(*([value for _, value in curve] for curve in found), strict=True))
        low, high = [min(column) for column in columns], [max(column) for column in columns]
        axes.fill_between(steps, low, high, color=color, alpha=0.12, linewidth=0)
        means = [statistics.fmean(column) for column in columns]
        axes.plot(steps, means, color=color, marker="o", markersize=4, label=f"{num_envs} envs")
    axes.set_title(title, fontsize=10.5)
    axes.set_xlabel("env states", fontsize=9)
    axes.set_ylabel("evaluation return; line: mean, band: all seeds", fontsize=9)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=9, frameon=False, loc="lower right")
    figure.savefig(picture, dpi=110)


def _title(cfg: RunCfg, num_seeds: int, figures: dict[str, float]) -> str:
    assert isinstance(cfg.data, DatasetCfg)
    return (
        f"{cfg.task_name}, {num_seeds} seeds, {cfg.data.num_env_states} env states per update\n"
        f"largest difference of two means: {figures['difference_in_deviations']:.2f} standard deviations of seeds, "
        f"{figures['at_most_in_deviations']:.2f} at most; p = {figures['p_value']:.2g}"
    )


def _table(title: str, scores: dict[int, list[float]], figures: dict[str, float]) -> Table:
    table = Table(title=f"{title}: mean evaluation return of {figures['seeds']:.0f} seeds")
    for column in ("num_envs", "least", "median", "most", "mean", "std"):
        table.add_column(column, justify="right")
    for num_envs, found in scores.items():
        own = (figures[f"{num_envs}_envs/mean"], figures[f"{num_envs}_envs/std"])
        shown = (min(found), statistics.median(found), max(found), *own)
        table.add_row(str(num_envs), *(f"{value:.1f}" for value in shown))
    table.caption = (
        f"largest difference {figures['largest_difference']:.1f} = {figures['difference_in_deviations']:.2f} "
        f"standard deviations of seeds, {figures['at_most_in_deviations']:.2f} at most; p = {figures['p_value']:.3f}"
    )
    return table


if __name__ == "__main__":
    command_line.run(main)
