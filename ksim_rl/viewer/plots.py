"""Curves of the last seconds of the shown env, with present values: its reward terms, and an observation term."""

import time
from collections import deque
from collections.abc import Mapping

import numpy as np
import viser
from viser import uplot

from ksim_rl.viewer.session import Session
from ksim_rl.viewer.shown_text import as_html

SECONDS = 5.0
PERIOD_S = 0.1
COLORS = (
    "#4269d0", "#efb118", "#ff725c", "#6cc5b0", "#3ca951", "#ff8ab7", "#a463f2", "#97bbf5", "#9c6b4e", "#9498a0",
)  # fmt: skip
# More columns of one observation are a smear.
MOST_CURVES = 16


class Curves:
    """A chart of named values over the last seconds of simulated time, with a table of their present values."""

    def __init__(self, gui: viser.GuiApi, folder: viser.GuiFolderHandle, *, points: int) -> None:
        self._gui = gui
        self._folder = folder
        # The oldest points fall out as new ones come.
        self._rows: deque[tuple[float, list[float]]] = deque(maxlen=points)
        self._names: tuple[str, ...] = ()
        self._chart: viser.GuiUplotHandle | None = None
        self._table = gui.add_html("")
        # The chart is made later, and has to stand above the table.
        self._order = self._table.order

    def add(self, seconds: float, values: Mapping[str, float]) -> None:
        """Take in the values of one env step; other names than before start a new chart."""
        names = tuple(values)
        # Time that runs backwards is a new session.
        if names != self._names or (self._rows and seconds <= self._rows[-1][0]):
            self._rows.clear()
        if names != self._names:
            self._names = names
            if self._chart is not None:
                self._chart.remove()
                self._chart = None
        self._rows.append((seconds, list(values.values())))

    def show(self) -> None:
        """Send the chart and the table."""
        # One point is no curve.
        if len(self._rows) < 2 or not self._names:
            return
        shown = self._names[:MOST_CURVES]
        x = np.array([seconds for seconds, _ in self._rows])
        y = np.array([values for _, values in self._rows])
        # Copies: viser wants each series contiguous.
        data = (x, *(y[:, column].copy() for column in range(len(shown))))
        if self._chart is None:
            series = [uplot.Series(label="s")]
            for column, name in enumerate(shown):
                series.append(
                    uplot.Series(label=name, stroke=COLORS[column % len(COLORS)], width=1.5)
                )
            with self._folder:
                self._chart = self._gui.add_uplot(
                    data,
                    tuple(series),
                    scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
                    legend=uplot.Legend(show=False),
                    height=180,
                    order=self._order - 0.5,
                )
        else:
            self._chart.data = data
        rows = []
        # Values beyond the curves are listed without a colour.
        for column, name in enumerate(self._names):
            if column < MOST_CURVES:
                color = COLORS[column % len(COLORS)]
            else:
                color = "inherit"
            rows.append(_row(name, color=color, value=y[-1, column]))
        self._table.content = (
            '<table style="width:100%;font-size:0.8em;font-variant-numeric:tabular-nums;padding:0 1em">'
            f"{''.join(rows)}</table>"
        )


def _row(name: str, *, color: str, value: float) -> str:
    """Return the row of a table: the colour of the curve, its name, which a run has chosen, and its present value."""
    shown = as_html(name)
    return (
        f'<tr><td style="color:{color}">&#9632;</td><td>{shown}</td>'
        f'<td style="text-align:right" data-value="{shown}">{value:+.4f}</td></tr>'
    )


class Plots:
    """The reward terms and one observation term of the shown env; a dropdown chooses which."""

    def __init__(self, gui: viser.GuiApi, folder: viser.GuiFolderHandle, session: Session) -> None:
        self._session = session
        # As many points as steps in the shown time.
        points = max(2, round(SECONDS / session.ours.step_dt))
        self._seconds = 0.0
        self._seen = session.steps
        self._shown_at = 0.0
        gui.add_markdown("**Reward terms** (weighted, per step)")
        self._rewards = Curves(gui, folder, points=points)
        gui.add_markdown("**Observation**")
        self._term = gui.add_dropdown("Term", tuple(session.observations) or ("none",))
        self._observation = Curves(gui, folder, points=points)

    def take(self) -> None:
        """Take in the last env step, if there was one."""
        session = self._session
        if session.steps == self._seen or not session.rewards:
            return
        # Simulated time since the last step that was taken in.
        self._seconds += (session.steps - self._seen) * session.ours.step_dt
        self._seen = session.steps
        self._rewards.add(self._seconds, session.rewards)
        values = session.observations.get(self._term.value)
        if values is not None:
            named = {f"{self._term.value}[{i}]": value for i, value in enumerate(values.tolist())}
            self._observation.add(self._seconds, named)

    def show(self) -> None:
        """Send the curves, a few times per second while it plays."""
        # Charts are large messages; a paused session is shown as it is.
        if time.monotonic() - self._shown_at >= PERIOD_S or not self._session.playing:
            self._shown_at = time.monotonic()
            self._rewards.show()
            self._observation.show()
