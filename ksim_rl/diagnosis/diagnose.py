"""`ksim-rl diagnose RUN` names the faults of learning that the metrics of a run show, and what to change."""

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ksim_rl.checks import OneLineParser
from ksim_rl.diagnosis.curves import LEAST_ROWS, Curves, read_run
from ksim_rl.diagnosis.faults import EXPLAINS, FAULTS
from ksim_rl.terminal import printable, show


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A fault that a run has."""

    name: str  # of the function that found it
    seen: str  # the figures that show it
    reason: str
    change: str  # what to try

    def __str__(self) -> str:
        """Return it as a paragraph."""
        name = self.name.replace("_", " ")
        return f"{name}: {printable(self.seen)}\n  {self.reason}\n  What to change: {self.change}"


def findings(curves: Curves) -> list[Finding]:
    """Return the faults that the curves show, except consequences of another fault."""
    # Too few rows: the medians of the beginning and the end would cover the same rows.
    if curves.num_rows < LEAST_ROWS:
        return []
    seen = {fault: text for fault in FAULTS if (text := fault(curves)) is not None}
    # Faults that another one explains would send the user to the wrong setting.
    follow = {effect for cause in seen for effect in EXPLAINS.get(cause, ())}
    found = []
    for fault, text in seen.items():
        if fault not in follow:
            # The docstring's first paragraph is the reason, the second the change.
            reason, _, change = inspect.cleandoc(fault.__doc__ or "").partition("\n\n")
            found.append(
                Finding(name=fault.__name__, seen=text, reason=_line(reason), change=_line(change))
            )
    return found


def one_line(folder: Path, name: str) -> str:
    """Return the faults in a run's metrics in one line, or why there are none to see; `name` is the user's for it."""
    try:
        curves = read_run(folder)
    except ValueError as error:
        return f"no diagnosis: {error}"
    found = findings(curves)
    if found:
        seen = "; ".join(f"{finding.name.replace('_', ' ')} ({finding.seen})" for finding in found)
        return f"diagnosis: {seen}. What to change: ksim-rl diagnose {name}"
    if curves.num_rows < LEAST_ROWS:
        return f"no diagnosis: {curves.num_rows} rows of metrics, and it takes {LEAST_ROWS}"
    return "diagnosis: the metrics show no fault"


def command(arguments: Sequence[str]) -> int:
    """Run `ksim-rl diagnose <arguments>`; the exit code is 1 where there is a fault."""
    parser = OneLineParser(
        prog="ksim-rl diagnose",
        description="Name the faults of learning that the metrics of a run show; the run may be under way.",
    )
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="a run folder, or one of its checkpoints"
    )
    folder = parser.parse_args(arguments).run
    curves = read_run(folder)
    found = findings(curves)
    show("\n".join(map(str, found)) if found else one_line(folder, str(folder)))
    return 1 if found else 0


def _line(text: str) -> str:
    return " ".join(text.split())
