"""Makes the table of docs/coming_from.md that has the differences of terms from mjlab's."""

from collections.abc import Mapping
from typing import Any

ROBOTS = {"go1": "Go1", "g1": "G1"}


def table(saved: Mapping[str, Any]) -> str:
    """Return the largest relative differences by kind of term, and in how many states forces differ."""
    figures = saved.get("figures", {})
    rows = [f"| largest relative difference | {' | '.join(ROBOTS.values())} |", "|---|---|---|"]
    for kind in ("reward", "observation", "termination", "clock", "action"):
        cells = [f"{figures[f'{robot}/largest_{kind}_difference']:.2g}" for robot in ROBOTS]
        rows.append(f"| {kind}s | {' | '.join(cells)} |")
    others = [
        f"{figures[f'{robot}/states_with_other_forces']} of {figures[f'{robot}/states']:,}"
        for robot in ROBOTS
    ]
    rows.append(
        f"| states in which contact forces differ by more than 0.1 % | {' | '.join(others)} |"
    )
    return "\n".join(rows)
