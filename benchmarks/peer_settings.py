"""Says how much of Go1's learning with PPO comes from three settings in which ours differ from mjlab's.

    python -m benchmarks.peer_settings device=cuda seeds=1,2,3 at_once=5

trains Go1 with our settings, with each of the three as the peer has it, and with all of them: a discount of 0.99,
torch's own initialization of all layers, and products in float32. mjlab's `train` command lets CUDA multiply float32
as TF32, so all three come twice: with products that are not cut (matmul_precision=highest), and as TF32.

Each run is a process of its own, `at_once` of them at a time, so that seconds are longer than of a run alone. Other
words are overrides of `ksim-rl train`; `variants=ours,discount` takes some of the variants. A level counts as reached
where the table `velocity` says so. Figures and curves go to benchmarks/results/peer_settings.json, the picture beside
it, and `python -m benchmarks.pages` writes the table of docs/notes/go1.md.
"""

from __future__ import annotations

import copy
import math
import multiprocessing
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from benchmarks import command_line, learning_curve, report
from benchmarks.learning_picture import finish_panel
from ksim_rl.algorithms import PPOUpdate
from ksim_rl.algorithms.ppo.fused import NotFused
from ksim_rl.checks import check_known
from ksim_rl.runs.csv_table import thinned
from ksim_rl.tables.levels import HELD_STATES, means_of, reached
from ksim_rl.tables.table import load
from ksim_rl.trainers import Hook, RunCfg, Trainer, build

TASK = "go1_velocity_flat"
LEVELS = load("velocity").rows["ppo/go1"].levels
KEPT = ("env_states", "seconds", *LEVELS)
KEPT_POINTS = 40
# Of the first rollout: bfloat16 moves the logarithm of a ratio by a hundredth in the median, another first policy by 3.
MOST_LOG_RATIO = 0.3
# Of weights before and after the first update: weights of two draws have a cosine near zero.
LEAST_COSINE = 0.5

Point = dict[str, float]


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Settings of a run: our own but for these overrides, and perhaps for the first weights."""

    label: str
    overrides: tuple[str, ...] = ()
    torch_initialization: bool = False


DISCOUNT = ("objective.gamma=0.99",)
TF32 = ("objective.precision=float32", "trainer.matmul_precision=high")
FLOAT32 = ("objective.precision=float32", "trainer.matmul_precision=highest")
VARIANTS = {
    "ours": Variant(label="ours"),
    "discount": Variant(label="discount 0.99", overrides=DISCOUNT),
    "initialization": Variant(label="torch's initialization", torch_initialization=True),
    "float32": Variant(label="float32, no TF32", overrides=FLOAT32),
    "all": Variant(
        label="all three, no TF32", overrides=(*DISCOUNT, *FLOAT32), torch_initialization=True
    ),
    "all_tf32": Variant(
        label="all three, TF32", overrides=(*DISCOUNT, *TF32), torch_initialization=True
    ),
}
OWN_OPTIONS = {
    "seeds": "1,2,3",
    "env_states": "40e6",
    "variants": ",".join(VARIANTS),
    "at_once": "1",
}
_COLORS = ("#3465a4", "#4e9a06", "#75507b", "#c4a000", "#a40000", "#888a85")


def main() -> None:
    """Train all runs, print and write what they show."""
    own, overrides = command_line.split(sys.argv[1:], OWN_OPTIONS)
    seeds = learning_curve.chosen_seeds(own, overrides)
    names = own["variants"].split(",")
    cfgs = {
        name: [run_cfg(name, seed, overrides, own["env_states"]) for seed in seeds]
        for name in names
    }
    at_once = command_line.whole_number("at_once", own["at_once"])
    spawn = multiprocessing.get_context("spawn")
    runs: dict[str, dict[int, Run]] = {}
    with ProcessPoolExecutor(at_once, spawn, max_tasks_per_child=1) as pool:
        begun = {
            name: [pool.submit(train, name, cfg) for cfg in found] for name, found in cfgs.items()
        }
        for name, futures in begun.items():
            runs[name] = dict(zip(seeds, (future.result() for future in futures), strict=True))
            # What is done stays, should a later run fail.
            path = write(cfgs[name][0], {name: runs[name]}, at_once=at_once)
    Console(width=160).print(_table(runs))
    cfg = cfgs[names[0]][0]
    draw(
        runs,
        path.with_suffix(".png"),
        title=f"{TASK}, PPO: {cfg.num_envs} envs, {len(seeds)} seeds",
    )
    print(f"written to {path}")


def run_cfg(name: str, seed: int, overrides: Sequence[str], env_states: str) -> RunCfg:
    """Compose the config of a variant's seed.

    Raises:
        ValueError: naming the variant or the override that is wrong.
    """
    check_known("variant", name, VARIANTS)
    words = [f"task={TASK}", "objective=ppo", f"seed={seed}", *overrides, *VARIANTS[name].overrides]
    return learning_curve.run_cfg(words, env_states)


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a process hands back: the log's rows, and how the networks began and were multiplied."""

    points: list[Point]
    facts: dict[str, Any]

    @property
    def found(self) -> dict[str, Any]:
        """The end of the first window in which the levels hold, None where there is none, and the last window."""
        end = reached(self.points, LEVELS)
        last = self.points[-1]
        held = [
            point
            for point in self.points
            if point["env_states"] >= last["env_states"] - HELD_STATES
        ]
        return {
            "env_states_to_levels": None if end is None else end["env_states"],
            "seconds_to_levels": None if end is None else round(end["seconds"], 2),
            "env_states": last["env_states"],
            "seconds": round(last["seconds"], 2),
            "means": {name: round(mean, 4) for name, mean in means_of(held, LEVELS).items()},
            **self.facts,
        }


class _Rows:
    """A logger that keeps the metrics which curves need."""

    def __init__(self) -> None:
        self.points: list[Point] = []

    def log_metrics(self, metrics: Mapping[str, float], step: int) -> None:
        row = {"env_states": float(step), **metrics}
        self.points.append({name: float(row[name]) for name in KEPT if name in row})

    def close(self) -> None:
        pass


class FirstPolicy(Hook):
    """Refuses a run that did not begin with the networks as they were when it `expects` them.

    The policy that collects, and kernels that make the gradient steps, hold weights of their own.
    """

    interval = 1

    def __init__(self) -> None:
        self.facts: dict[str, float] = {}

    def expects(self, update: PPOUpdate) -> None:
        """Keep the policy, with the statistics that it begins with, and all weights."""
        self._actor, self._weights = copy.deepcopy(update.actor), _weights(update)

    @torch.no_grad()
    def __call__(self, trainer: Trainer) -> None:
        """Compare, after the first iteration only; a RuntimeError says what is other."""
        self.interval = 0
        actor, rollout_ET = self._actor, trainer.rollout_ET
        (action_key,), (log_prob_key,) = actor.dist_sample_keys, actor.log_prob_keys
        policy = actor.get_dist(rollout_ET.select(*actor.in_keys))
        log_ratio_ET = policy.log_prob(rollout_ET[action_key]) - rollout_ET[log_prob_key]
        log_ratio = float(log_ratio_ET.abs().median())
        if not log_ratio < MOST_LOG_RATIO:
            raise RuntimeError(
                "the policy that collected first is not the networks' own: the logarithms of its ratios to it have "
                f"a median of {log_ratio:.3g}, at most {MOST_LOG_RATIO} was expected"
            )
        cosine = float(torch.cosine_similarity(self._weights, _weights(trainer.update), dim=0))
        if not cosine > LEAST_COSINE:
            raise RuntimeError(
                "the first update did not begin with the weights of the networks: those after it have a cosine of "
                f"{cosine:.3g} with them, at least {LEAST_COSINE} was expected"
            )
        facts = {
            "first_log_ratio": log_ratio,
            "first_cosine": cosine,
            "first_kl": trainer.metrics["update/kl"],
        }
        self.facts = {name: round(value, 6) for name, value in facts.items()}


def _layers(update: Any) -> list[nn.Linear]:
    parts = (part for network in update.networks.values() for part in network.modules())
    return [part for part in parts if isinstance(part, nn.Linear)]


def _weights(update: Any) -> Tensor:
    return torch.cat([layer.weight.detach().flatten() for layer in _layers(update)])


@torch.no_grad()
def initialize_as_torch(update: PPOUpdate, *, seed: int) -> None:
    """Give all linear layers, in place, the weights and biases that torch gives a new one, as rsl_rl leaves them."""
    # As ours: drawn on the CPU, so that one seed gives the same networks on every device.
    with torch.random.fork_rng([]):
        torch.default_generator.manual_seed(seed)
        for layer in _layers(update):
            drawn = nn.Linear(layer.in_features, layer.out_features)
            layer.weight.copy_(drawn.weight)
            layer.bias.copy_(drawn.bias)


def train(name: str, cfg: RunCfg) -> Run:
    """Train one seed of a variant."""
    rows, first = _Rows(), FirstPolicy()
    trainer = build(cfg, hooks=[first])
    update = trainer.update
    assert isinstance(update, PPOUpdate)
    if VARIANTS[name].torch_initialization:
        initialize_as_torch(update, seed=cfg.seed)
    first.expects(update)
    trainer.loggers = [rows]
    trainer.train()
    trainer.collector.env.close(raise_if_closed=False)
    if not any(set(LEVELS) <= set(point) for point in rows.points):
        raise ValueError(
            f"no episode ended within {cfg.trainer.num_iterations} iterations: raise env_states"
        )
    # What the process really did, as the config says no more than what was asked for.
    facts = {
        **first.facts,
        "precision": update.cfg.precision,
        "matmul_precision": torch.get_float32_matmul_precision(),
        "fused": not isinstance(update.fused, NotFused),
    }
    run = Run(points=rows.points, facts=facts)
    print(f"{name}, seed {cfg.seed}: {run.found}", flush=True)
    return run


def write(cfg: RunCfg, runs: Mapping[str, Mapping[int, Run]], *, at_once: int) -> Path:
    """Write figures, what each seed came to, and thinned curves; return the file's path."""
    device = cfg.resolved_device()
    label = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    figures: dict[str, float] = {}
    for name, of_seeds in runs.items():
        found = [run.found for run in of_seeds.values()]
        figures[f"{label}/{name}/seeds_at_levels"] = sum(
            one["env_states_to_levels"] is not None for one in found
        )
        for reward in LEVELS:
            values = [one["means"][reward] for one in found if reward in one["means"]]
            short = reward.removeprefix("reward/")
            figures |= (
                {f"{label}/{name}/{short}": round(statistics.median(values), 4)} if values else {}
            )
    return report.write(
        "peer_settings",
        figures=figures,
        device=device,
        module="benchmarks.peer_settings",
        seeds={
            f"{label}/{name}": {
                "at_once": at_once,
                "runs": {str(seed): run.found for seed, run in own.items()},
            }
            for name, own in runs.items()
        },
        curves={
            f"{label}/{name}/seed_{seed}": [
                {key: round(value, 4) for key, value in point.items()}
                for point in thinned(run.points, KEPT_POINTS)
            ]
            for name, own in runs.items()
            for seed, run in own.items()
        },
    )


def median_of(found: Iterable[Mapping[str, Any]], key: str) -> float | None:
    """Return the median over seeds, where None stands for a seed that never got there; None if the median is None."""
    middle = statistics.median(math.inf if one[key] is None else one[key] for one in found)
    return middle if math.isfinite(middle) else None


def held_means(points: Sequence[Point]) -> list[Point]:
    """Return a curve's means over the `HELD_STATES` before each point, which is what the levels are compared with."""
    means = []
    for end in (point["env_states"] for point in points):
        window = [point for point in points if end - HELD_STATES <= point["env_states"] <= end]
        means.append({"env_states": end, **means_of(window, LEVELS)})
    return means


def median_curve(curves: Sequence[Sequence[Point]], name: str) -> list[tuple[float, float]]:
    """Return (env states, median over the seeds that have a value there)."""
    values: dict[float, list[float]] = {}
    for point in (point for curve in curves for point in curve if name in point):
        values.setdefault(point["env_states"], []).append(point[name])
    return [(env_states, statistics.median(found)) for env_states, found in sorted(values.items())]


def draw(runs: Mapping[str, Mapping[int, Run]], picture: Path, *, title: str) -> None:
    """Draw the median of each variant's seeds, and the seeds as thin lines, beside the peer's curve."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12)
    for column, (reward, level) in enumerate(LEVELS.items(), 1):
        axes = figure.add_subplot(1, len(LEVELS), column)
        axes.axhline(level, color="black", linewidth=0.8, linestyle=":")
        for (name, of_seeds), color in zip(runs.items(), _COLORS, strict=False):
            curves = [held_means(run.points) for run in of_seeds.values()]
            for curve in curves:
                axes.plot(
                    *_columns(median_curve([curve], reward)), color=color, linewidth=0.6, alpha=0.35
                )
            line = _columns(median_curve(curves, reward))
            axes.plot(*line, color=color, linewidth=1.8, label=VARIANTS[name].label)
        finish_panel(axes, reward, task_name=TASK)
        axes.set_xlabel("env states; rewards are means over the last million", fontsize=9)
        if column == 1:
            axes.legend(fontsize=8, frameon=False, loc="lower right")
    figure.savefig(picture, dpi=110)


def _columns(pairs: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    return [first for first, _ in pairs], [second for _, second in pairs]


def _table(runs: Mapping[str, Mapping[int, Run]]) -> Table:
    table = Table(
        title=f"{TASK}: {' and '.join(f'{level:.2f}' for level in LEVELS.values())}, median of seeds"
    )
    for column in (
        "settings",
        "seeds at the levels",
        "env states to them",
        "seconds",
        "rewards at the end",
    ):
        table.add_column(column, justify="left" if column == "settings" else "right")
    for name, own in runs.items():
        found = [run.found for run in own.values()]
        at_levels = sum(one["env_states_to_levels"] is not None for one in found)
        medians = [median_of(found, f"{unit}_to_levels") for unit in ("env_states", "seconds")]
        ends = [
            statistics.median(one["means"].get(reward, 0.0) for one in found) for reward in LEVELS
        ]
        cells = ["–" if value is None else f"{value:,.4g}" for value in medians]
        rewards = " and ".join(f"{end:.2f}" for end in ends)
        table.add_row(VARIANTS[name].label, f"{at_levels} of {len(found)}", *cells, rewards)
    return table


if __name__ == "__main__":
    command_line.run(main)
