"""These rows send to the viewer what strangers may: names in a run that are markup."""

from __future__ import annotations

from pathlib import Path

from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row


def viewer_markup(folder: Path, *, names: int) -> Figures:
    """Show a run whose rewards, observations, title, note and errors are markup."""
    from tests.viewer.markup import MARKUP, figures

    return figures(list(MARKUP.values())[:names])


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
}
