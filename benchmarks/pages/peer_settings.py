"""Makes the table of docs/notes/go1.md that compares settings of ours with mjlab's."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.learning_picture import PEER
from benchmarks.pages.committed import last_on_gpu
from benchmarks.peer_settings import LEVELS, TASK, VARIANTS, median_of

UNKNOWN = "How much of the difference in env states each of them makes was not measured."
COLUMNS = ("settings", "seeds", "env states", "seconds", "rewards")


def text(saved: Mapping[str, Any]) -> str:
    """What the last run on a GPU has to say, or that there is none."""
    runs = saved.get("runs", {})
    if (last := last_on_gpu(runs)) is None:
        return UNKNOWN
    prefix = last.rpartition("/")[0]
    own = {
        name: saved["seeds"][key]
        for name in VARIANTS
        if (key := f"{prefix}/{name}") in saved["seeds"]
    }
    made_by = {key: runs[f"{prefix}/{key}"] for key in own}
    commits = " and ".join(dict.fromkeys(run["commit"][:7] for run in made_by.values()))
    at_once = max(found["at_once"] for found in own.values())
    of_how_many = f", {at_once} runs at a time, whose seconds these are" if at_once > 1 else ""
    head = (
        "With each of them as mjlab has it, and with all, medians of seeds until both levels hold, and rewards at the\n"
        f"end ({runs[last]['device']}, commit {commits}{of_how_many}):\n"
    )
    rows = [row(VARIANTS[name].label, [*found["runs"].values()]) for name, found in own.items()]
    command = next(iter(made_by.values()))["command"]
    return "\n".join(
        [
            head,
            f"| {' | '.join(COLUMNS)} |",
            "|" + "---|" * len(COLUMNS),
            *rows,
            peer_row(),
            "",
            f"`{command}`",
            "",
            "![Go1 with our settings and with mjlab's](../../benchmarks/results/peer_settings.png)",
        ]
    )


def row(label: str, found: Sequence[Mapping[str, Any]]) -> str:
    at_levels = sum(one["env_states_to_levels"] is not None for one in found)
    env_states, seconds = (
        median_of(found, f"{unit}_to_levels") for unit in ("env_states", "seconds")
    )
    ends = " and ".join(
        f"{statistics.median(one['means'][name] for one in found):.2f}" for name in LEVELS
    )
    cells = (
        label,
        f"{at_levels} of {len(found)}",
        "" if env_states is None else f"{env_states / 1e6:.1f} million",
        "" if seconds is None else f"{seconds:.1f}",
        f"{ends} after {max(one['env_states'] for one in found) / 1e6:.0f} million",
    )
    return f"| {' | '.join(cells)} |"


def peer_row() -> str:
    """The last point of mjlab's curve, which is where the levels are from."""
    peer = PEER[TASK]
    env_states = f"{peer['env_states'][-1] / 1e6:.1f} million"
    ends = " and ".join(f"{peer[name][-1]:.2f}" for name in LEVELS)
    return (
        f"| mjlab | one curve | {env_states} | {peer['seconds'][-1]} | {ends} after {env_states} |"
    )
