"""Makes the tables of docs/speed.md that follow from one result each."""

import math
import statistics
from collections.abc import Mapping
from typing import Any

from benchmarks import determinism
from benchmarks.pages.committed import results
from benchmarks.pages.table import table

GO1 = "h200/go1_velocity_flat/4096"
NUM_ENVS = 4096
STEPS = 24
# Of an iteration: label, name of the figure, env steps in that time.
PARTS = (
    ("raw physics (4 captured `mjw.step` of MuJoCo Warp, sensors in each)", "physics_ms", 1),
    ("own substeps (five kernels)", "own_physics_ms", 1),
    ("env step (commands, rewards, observations with noise, masked reset)", "env_step_ms", 1),
    ("rollout with policy", "rollout_ms", STEPS),
    ("PPO update (bfloat16, fused kernels)", "update_ms", STEPS),
    ("whole training iteration", "iteration_ms", STEPS),
)
TRAINED = {
    "base": "4 steps of 5 ms",
    "large": "2 steps of 10 ms",
    "discrete": "the same, `task.sim.integrator=discrete`",
}


def iteration() -> str:
    """Return the table of the parts of an iteration, beside MuJoCo Warp's physics alone."""
    figures = results("throughput")["figures"]
    raw = NUM_ENVS * 1000 / figures[f"{GO1}/physics_ms"]
    rows = []
    for label, name, steps in PARTS:
        ms = figures[f"{GO1}/{name}"]
        per_s = steps * NUM_ENVS * 1000 / ms
        rows.append([label, three_digits(ms), f"{per_s:,.0f}", three_digits(per_s / raw)])
    return table(("", "ms", "env states/s", "relative to raw physics"), rows)


def three_digits(value: float) -> str:
    """Return a number with two decimals, or one from ten on."""
    if value < 10:
        return f"{value:.2f}"
    return f"{value:.1f}"


def equal_runs() -> str:
    """Return the table of two runs from one seed: how many tensors were compared, and how many differ."""
    figures = results("determinism")["figures"]
    rows = []
    for task in determinism.TASKS:
        compared = figures.get(f"h200/{task}/tensors")
        if compared is None:
            rows.append([EQUAL_RUNS[task], "not measured yet", ""])
            continue
        differ = figures[f"h200/{task}/tensors_that_differ"]
        rows.append([EQUAL_RUNS[task], f"{compared:.0f}", f"{differ:.0f}"])
    return table(("task", "tensors compared", "differ"), rows)


EQUAL_RUNS = {
    "go1_velocity_flat": "`go1_velocity_flat`",
    "g1_velocity_flat": "`g1_velocity_flat`",
    "go1_velocity_flat_fast_sac": "`go1_velocity_flat`, `objective=fast_sac`",
    "arm_push": "`arm_push` (2048 envs)",
    "arm_clutter": "`arm_clutter` (2048 envs): `arm_push` among six more cubes, 28 contacts in a world",
    "cartpole_balance_pixels": "`cartpole_balance_pixels`",
}
"""What the table calls the runs of `benchmarks.determinism`."""


def larger_steps() -> str:
    """Return the table of policies that larger time steps trained, on the C engine with smaller ones."""
    figures = results("sim2sim")["figures"]
    base, base_error = mean_and_error(of_seeds(figures, "base", "return_c_engine"))
    rows = []
    for name, label in TRAINED.items():
        mean, error = mean_and_error(of_seeds(figures, name, "return_c_engine"))
        returned = f"{mean:.1f}"
        if name != "base":
            ratio = mean / base
            spread = ratio * math.hypot(error / mean, base_error / base)
            returned += f", or {ratio:.3f} ± {spread:.3f} of it"
        fell = statistics.fmean(of_seeds(figures, name, "fell"))
        rows.append([label, returned, f"{100 * fell:.1f} %"])
    head = ("trained with", "return at 5 ms on MuJoCo's C engine", "falls at 5 ms in our physics")
    return table(head, rows)


def of_seeds(figures: Mapping[str, Any], name: str, figure: str) -> list[float]:
    """Return a figure of the three seeds of a setting."""
    label = f"go1_velocity_flat/without_noise/{name}_seed_"
    return [figures[f"{label}{seed}/{figure}"] for seed in (1, 2, 3)]


def mean_and_error(values: list[float]) -> tuple[float, float]:
    """Return the mean of some seeds and its standard error."""
    return statistics.fmean(values), statistics.stdev(values) / math.sqrt(len(values))
