"""`ksim-rl runs` lists runs, `ksim-rl compare` sets them side by side; both read run folders as data."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ksim_rl.checks import OneLineParser
from ksim_rl.cli.report import shown
from ksim_rl.files.writing import check_place, whole_file
from ksim_rl.runs import comparison, listing
from ksim_rl.terminal import printable, show

ORDERS = {"began": "began", "return": "evaluation", "speed": "speed"}


def runs(arguments: list[str]) -> int:
    """List the runs in folders."""
    parser = OneLineParser(prog="ksim-rl runs", description="List runs with return and speed.")
    parser.add_argument(
        "folders", nargs="*", type=Path, default=[Path("runs")], help="default: runs"
    )
    parser.add_argument("--task", help="only runs of this task")
    parser.add_argument(
        "--sort", choices=ORDERS, default="began", help="the highest or newest comes last"
    )
    options = parser.parse_args(arguments)
    found = [listing.summarize(run) for folder in options.folders for run in listing.find(folder)]
    chosen = [summary for summary in found if options.task in (None, summary.task)]
    field = ORDERS[options.sort]
    # Runs without a figure come first, as the last lines are the ones that are seen.
    ordered = sorted(
        chosen,
        key=lambda summary: (getattr(summary, field) is not None, getattr(summary, field) or 0.0),
    )
    if not ordered:
        show(f"no runs in {', '.join(map(shown, options.folders))}")
        return 0
    print_table(
        listing.HEADS, (listing.line(summary, name=shown(summary.folder)) for summary in ordered)
    )
    return 0


def compare(arguments: list[str]) -> int:
    """Print figures and differences of runs, and draw their curves."""
    parser = OneLineParser(
        prog="ksim-rl compare", description="Compare runs: a table and a picture."
    )
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="run folders, two or more"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("compare.png"), help="a .png file; default: compare.png"
    )
    options = parser.parse_args(arguments)
    if len(options.runs) < 2:
        raise ValueError(f"{options.runs[0]}: name at least two runs to compare")
    if options.output.suffix != ".png":
        raise ValueError(f"--output {options.output}: expected a file that ends in .png")
    check_place("--output", options.output, is_folder=False)
    for folder in options.runs:
        if not (folder / listing.CONFIG).exists():
            # Not `find`: these folders were named, so a wrong name is an error.
            raise ValueError(f"{folder}: expected a run folder, which has a {listing.CONFIG}")
    head, *rows = comparison.figures(options.runs)
    print_table(head, rows)
    with whole_file(options.output) as temporary:
        comparison.draw(options.runs, temporary)
    show(shown(options.output))
    return 0


class TableOfJobs(Callback):
    """Ends a multirun with a table of its runs; Hydra calls it."""

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Print the runs in the sweep's folder, by the numbers of their jobs."""
        folder = Path(str(config.hydra.sweep.dir))
        # Jobs are called "<number>_<overrides>": by length first, so that 10 comes after 9.
        found = sorted(
            listing.find(folder), key=lambda run: (len(run.name.partition("_")[0]), run.name)
        )
        print_table(
            listing.HEADS, (listing.line(listing.summarize(run), name=run.name) for run in found)
        )
        show(f"{shown(folder)}: ksim-rl runs {shown(folder)} --sort return")


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print rows under heads; in a pipe nothing is wrapped, so that each row stays one line."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for index, head in enumerate(heads):
        # Only the first column may not wrap: it has the name that is copied.
        table.add_column(Text(head), no_wrap=index == 0)
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    console = Console(highlight=False)
    # A pipe has no width of its own.
    Console(highlight=False, width=None if console.is_terminal else 400).print(table)
