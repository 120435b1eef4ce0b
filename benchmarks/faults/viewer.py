"""These rows send to the viewer what strangers may: names in a run that are markup, and messages."""

from __future__ import annotations

from pathlib import Path

from benchmarks.faults.row import AT_LEAST, AT_MOST, EXACTLY, Figures, Row


def viewer_markup(folder: Path, *, names: int) -> Figures:
    """Show a run whose rewards, observations, title, note and errors are markup."""
    from tests.viewer.markup import MARKUP, figures

    return figures(list(MARKUP.values())[:names])


def viewer_ports(folder: Path, *, messages: int) -> Figures:
    """Connect to both ports as strangers, and send as their pages what these never send."""
    from tests.viewer.strange_clients import figures

    return figures(messages=messages)


ROWS = {
    "viewer_markup": Row(
        fault="names of rewards and observations, titles, notes and errors of a run that are HTML, scripts or markdown",
        must="each stands in the viewer's page as text; none is obeyed",
        limits={
            "names": (AT_LEAST, "names"),
            **dict.fromkeys(("obeyed", "not_shown_as_text", "in_markdown"), (EXACTLY, 0)),
        },
        measure=viewer_markup,
        amounts={"names": 11},
        short={"names": 4},
        files=("ksim_rl/viewer", "tests/viewer/markup.py"),
    ),
    "viewer_ports": Row(
        fault="other sites, rebound names and clients without the token; malformed messages; numbers beyond; floods",
        must="no stranger is let in; messages are ignored and counted, numbers clamped; the queue is bounded",
        limits={
            "strangers": (AT_LEAST, 56),
            "messages": (AT_LEAST, 35),
            "own_page_drives": (EXACTLY, 1),
            "waiting_at_most": (AT_MOST, 256),
            **dict.fromkeys(("let_in", "not_ignored", "beyond_the_control"), (EXACTLY, 0)),
        },
        measure=viewer_ports,
        amounts={"messages": 100_000},
        short={"messages": 2_000},
        files=("ksim_rl/viewer", "tests/viewer/strange_clients.py"),
    ),
}
