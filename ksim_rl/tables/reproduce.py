"""`ksim-rl reproduce TABLE` runs the missing jobs of a table, and writes it as JSON, Markdown and a picture."""

import math
import re
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import torch

from ksim_rl.checks import OneLineParser, check_in_range, near
from ksim_rl.files.writing import check_place
from ksim_rl.tables import report
from ksim_rl.tables.levels import is_reached
from ksim_rl.tables.lineage import depth_of
from ksim_rl.tables.measure import run_cfg
from ksim_rl.tables.runner import Runs, gpus_for
from ksim_rl.tables.table import Row, load, shipped
from ksim_rl.terminal import show


def reproduce(arguments: Sequence[str]) -> int:
    """Run the command; the code is 1 where a row does not reach its goal or has no result, 0 else."""
    options = _parser().parse_args(arguments)
    began = time.monotonic()
    smoke = options.smoke
    check_place("--output", options.output, is_folder=True)
    check_place("--runs", options.runs, is_folder=True)
    table = load(options.table)
    seeds = [int(word) for word in options.seeds.split(",") if word]
    rows = {name: row for name, row in table.rows.items() if re.fullmatch(options.rows, name)}
    # Seeds of the table only: others would be chosen by their results.
    known = sorted({seed for row in rows.values() for seed in row.seeds})
    if not rows:
        raise ValueError(
            f"--rows {options.rows}: {table.name} has no such: {near(options.rows, table.rows)}"
        )
    if strangers := set(seeds) - set(known):
        raise ValueError(
            f"--seeds: {strangers} are none of {known}; try other seeds with ksim-rl train"
        )
    # Times are measured: another run on the GPU would lengthen them.
    timed = []
    for name, row in rows.items():
        if row.measure == "seconds" or "seconds" in row.figures.values():
            timed.append(name)
    check_in_range("--per-gpu", options.per_gpu, low=1)
    if options.per_gpu > 1 and timed:
        raise ValueError(
            f"--per-gpu {options.per_gpu}: runs that share a GPU wait for each other, and {timed[0]} measures seconds; "
            "leave it out, or choose other --rows"
        )
    # In a checkout the results belong to the repository.
    if Path("benchmarks/results").is_dir():
        default = "benchmarks/results/tables"
    else:
        default = "tables"
    output = (options.output or Path(default)) / ("smoke" if smoke else "")
    run_folder = options.runs / ("smoke" if smoke else "") / table.name
    # A machine without a GPU does what it can.
    if torch.cuda.is_available():
        device = options.device
    else:
        device = "cpu"
    runs = Runs(table, output / table.name, run_folder, smoke=smoke)

    def write(said: str) -> None:
        # After each job, so that a stop leaves the table of all that is done.
        report.write(table, runs.complete(seeds), output, seeds=seeds)
        show(said)

    # A smoke test always runs, since its results say nothing.
    present = {} if smoke else runs.results()
    # Seed by seed, so that a table that is cut off has some seeds of all rows; the longest first, to end together, but
    # behind the rows that they learn from.
    jobs = [
        (name, seed)
        for seed in seeds or known
        for name, row in sorted(rows.items(), key=partial(_rank, table.rows))
        if seed in row.seeds and seed not in present.get(name, {})
    ]
    # One seed is enough to check a row's config.
    for name in {name for name, _ in jobs}:
        # What is wrong is said before anything runs.
        run_cfg(rows[name], 1, device="cpu", smoke=smoke)
    gpus = gpus_for(device, per_gpu=options.per_gpu)
    left = runs.run(jobs, gpus=gpus, until=began + 60.0 * options.minutes, note=write)
    write(f"{left} runs are missing; the table is {output / table.name}.md")
    done = runs.complete(seeds)
    missed = [name for name in rows if name in done and is_reached(rows[name], done[name]) is False]
    return 1 if left or (missed and not smoke) else 0


def _rank(rows: Mapping[str, Row], named: tuple[str, Row]) -> tuple[int, float]:
    name, row = named
    return depth_of(rows, name), -row.env_states


def _parser() -> OneLineParser:
    parser = OneLineParser(
        prog="ksim-rl reproduce",
        description="Run what is missing of a table of results, and write the table. Results that are there stay.",
    )
    parser.add_argument("table", help=f"one of {', '.join(shipped())}, or a YAML file of yours")
    parser.add_argument(
        "--rows", default=".*", help="regular expression of rows, such as 'ppo/Walker.*'"
    )
    parser.add_argument("--seeds", default="", help="some of the table's, such as 1,2")
    parser.add_argument("--device", default="cuda", help="cpu, or cuda where there is a GPU")
    parser.add_argument(
        "--per-gpu", type=int, default=1, help="runs that share a GPU, if none is timed"
    )
    parser.add_argument(
        "--output", type=Path, help="default: benchmarks/results/tables, or tables elsewhere"
    )
    parser.add_argument("--runs", type=Path, default=Path("runs/tables"), help="where the runs lie")
    parser.add_argument(
        "--minutes", type=float, default=math.inf, help="end then; 0 writes what is there"
    )
    parser.add_argument(
        "--smoke", action="store_true", help="two iterations each: does it run at all?"
    )
    return parser
