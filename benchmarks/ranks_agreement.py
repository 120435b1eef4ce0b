"""Shows that several ranks learn what one process learns, joined by gloo on the CPU.

    python -m benchmarks.ranks_agreement

trains each algorithm on 2 and on 4 ranks, and in one process with as many shards, and prints how many tensors of the
update were compared and their largest difference; then a run on two ranks goes on in one process and on two again, and
its curve is compared with a run without a break. `names=ppo,gru` and `sizes=2` choose, `resumed=no` leaves the
second part out. Figures and curves go to benchmarks/results/ranks.json, the picture to ranks_resumed.png beside it.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from functools import partial
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from benchmarks.ranks import output, start

OPTIONS = {"names": "all", "sizes": "2,4", "resumed": "yes"}
ITERATIONS = (15, 30, 45)  # after which the run goes on with another number of ranks
RUN = (
    "task=cartpole_balance",
    "device=cpu",
    "num_envs=32",
    "data.num_env_states_per_minibatch=256",
    "trainer.num_threads=1",
    "trainer.eval_episodes=0",
    "trainer.video=false",
    "hydra.run.dir=run",
)
RETURN = "episode/return"
# Iterations after the first change in which rounding, which learning magnifies, is not yet the larger part.
AFTERWARDS = 5


def curve(run: Path) -> list[tuple[float, float]]:
    """Return env states and mean return of each row of a run's metrics that has one."""
    with open(run / "metrics.csv", newline="") as file:
        rows = [(row["env_states"], row[RETURN]) for row in csv.DictReader(file)]
    return [(float(env_states), float(value)) for env_states, value in rows if value]


def curves() -> dict[str, list[tuple[float, float]]]:
    """Train on two ranks, in one process and on two again, and without a break; return both curves."""
    found = {}
    for name, ends in (("2 to 1 to 2", ITERATIONS), ("2 throughout", ITERATIONS[-1:])):
        with tempfile.TemporaryDirectory() as folder:
            for part, end in enumerate(ends):
                words = ("resume", "run", f"--num-iterations={end}", "--device=cpu")
                if part == 0:
                    words = ("train", *RUN, f"trainer.num_iterations={end}")
                output(
                    start(1 if part == 1 else 2, "ksim_rl.cli.main", *words, folder=Path(folder))
                )
            found[name] = curve(Path(folder, "run"))
    return found


def draw(found: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Draw curves, and where the number of ranks changed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.add_subplot(xlabel="env states", ylabel="mean return")
    for (name, points), style in zip(found.items(), ("-", "--"), strict=True):
        axes.plot(*zip(*points, strict=True), style, label=name)
    for end in ITERATIONS[:-1]:
        axes.axvline(
            end / ITERATIONS[-1] * next(iter(found.values()))[-1][0], color="0.8", zorder=0
        )
    axes.legend()
    figure.savefig(path, dpi=100)


def main() -> None:
    """Compare all, and write the figures."""
    from tests.ranks import test_agreement, test_imitation

    own = command_line.options(sys.argv[1:], OPTIONS)
    compared = dict.fromkeys(test_agreement.ALGORITHMS, test_agreement.compared)
    compared |= dict.fromkeys(test_imitation.ALGORITHMS, test_imitation.compared)
    names = list(compared) if own["names"] == "all" else own["names"].split(",")
    device = torch.device("cpu")
    saved = partial(report.write, "ranks", device=device, module="benchmarks.ranks_agreement")
    table = Table("algorithm", "ranks", "tensors", "largest difference")
    torch.set_num_threads(1)  # as each rank has it
    for name in names:
        for size in command_line.whole_numbers("sizes", own["sizes"], least=2):
            with tempfile.TemporaryDirectory() as folder:
                tensors, worst = compared[name](name, size, Path(folder))
            table.add_row(name, str(size), str(tensors), f"{worst:.2g}")
            prefix = f"cpu/agreement/{name}/{size}"
            saved(figures={f"{prefix}/tensors": tensors, f"{prefix}/largest_difference": worst})
    Console().print(table)
    if own["resumed"] == "yes":
        found = curves()
        (_, resumed), (_, whole) = found.items()
        apart = [abs(one[1] / other[1] - 1.0) for one, other in zip(resumed, whole, strict=True)]
        first, then = max(apart[: ITERATIONS[0]]), max(apart[: ITERATIONS[0] + AFTERWARDS])
        print(
            f"2 to 1 to 2: returns are {first:.2g} apart before the change, {then:.2g} in the {AFTERWARDS} after it"
        )
        draw(found, report.RESULTS / "ranks_resumed.png")
        figures = {
            "cpu/resumed/returns_apart_before": first,
            "cpu/resumed/returns_apart_in_5_iterations_after": then,
            "cpu/resumed/last_return": resumed[-1][1],
            "cpu/resumed/last_return_without_a_break": whole[-1][1],
        }
        saved(figures=figures, curves=found)
    print(f"written to {report.RESULTS / 'ranks.json'}")


if __name__ == "__main__":
    command_line.run(main)
