"""What docs/notes/go1.md says about settings of the peer is what benchmarks/results/peer_settings.json has.

To write it anew: python -m tests.docs.test_peer_settings.
"""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from benchmarks import report
from benchmarks.learning_picture import PEER
from benchmarks.peer_settings import LEVELS, TASK, VARIANTS, median_of
from tests.docs.committed import last_on_gpu, results
from tests.docs.guide import DOCS

PAGE = DOCS / "notes" / "go1.md"
BEGIN = "<!-- peer settings: python -m tests.docs.test_peer_settings writes what follows -->"
END = "<!-- end of peer settings -->"
UNKNOWN = "How much of the difference in env states each of them makes was not measured."
COLUMNS = ("settings", "seeds", "env states", "seconds", "rewards")


def text(saved: Mapping[str, Any]) -> str:
    """What the last run on a GPU has to say, or that there is none."""
    runs = saved.get("runs", {})
    if (last := last_on_gpu(runs)) is None:
        return UNKNOWN
    prefix = last.rpartition("/")[0]
    own = {name: saved["seeds"][key] for name in VARIANTS if (key := f"{prefix}/{name}") in saved["seeds"]}
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
    env_states, seconds = (median_of(found, f"{unit}_to_levels") for unit in ("env_states", "seconds"))
    ends = " and ".join(f"{statistics.median(one['means'][name] for one in found):.2f}" for name in LEVELS)
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
    return f"| mjlab | one curve | {env_states} | {peer['seconds'][-1]} | {ends} after {env_states} |"


def page() -> str:
    """The page with what was measured written anew."""
    return report.filled(PAGE.read_text(), BEGIN, END, text(results("peer_settings")))


def test_the_page_says_what_was_measured():
    assert PAGE.read_text() == page(), "out of date: python -m tests.docs.test_peer_settings"


def run(*, env_states_to_levels=None, seconds_to_levels=None, linear=1.6, angular=1.3):
    means = {"reward/track_linear_velocity": linear, "reward/track_angular_velocity": angular}
    levels = {"env_states_to_levels": env_states_to_levels, "seconds_to_levels": seconds_to_levels}
    return {"env_states": 4.0e7, "means": means, **levels}


@pytest.mark.parametrize("at_once", [1, 5])
def test_a_table_has_medians_and_says_where_a_level_was_not_reached(at_once):
    reached = [run(env_states_to_levels=states, seconds_to_levels=states / 1e6) for states in (3e7, 1e7, 2e7)]
    never = [reached[0], run(linear=1.2, angular=0.9), run(linear=1.0, angular=0.8)]
    prefix, made = "h200/go1_velocity_flat/4096", {"device": "NVIDIA H200", "command": "python -m it"}
    saved = {
        "runs": {
            f"{prefix}/ours": {**made, "commit": "abcdef012", "date": "2"},
            f"{prefix}/all": {**made, "commit": "abcdef012", "date": "2"},
            "h100/go1_velocity_flat/4096/ours": {**made, "commit": "1", "date": "1", "device": "older"},
            "cpu/go1_velocity_flat/16/ours": {**made, "commit": "2", "date": "3", "device": "a CPU"},
        },
        "seeds": {
            f"{prefix}/{name}": {"at_once": at_once, "runs": dict(zip("123", found, strict=True))}
            for name, found in (("ours", reached), ("all", never))
        },
    }
    said = text(saved)
    for line in (
        "| ours | 3 of 3 | 20.0 million | 20.0 | 1.60 and 1.30 after 40 million |",
        "| all three, no TF32 | 1 of 3 |  |  | 1.20 and 0.90 after 40 million |",
        "| mjlab | one curve | 29.5 million | 192 | 1.39 and 1.20 after 29.5 million |",
    ):
        assert line in said.splitlines(), said
    assert "NVIDIA H200, commit abcdef0" in said and "older" not in said and "a CPU" not in said
    assert ("5 runs at a time" in said) == (at_once == 5)
    assert text({}) == text({"runs": {"cpu/go1_velocity_flat/16/ours": made}}) == UNKNOWN


if __name__ == "__main__":
    PAGE.write_text(page())
