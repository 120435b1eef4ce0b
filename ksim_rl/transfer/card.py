"""A transfer card: how much of its return a policy keeps under each condition, as a page, a picture and numbers."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ksim_rl.files.writing import write_whole
from ksim_rl.runs.plotting import Figure, FigureCanvasAgg, plain_style
from ksim_rl.terminal import printable
from ksim_rl.transfer.conditions import CONDITIONS
from ksim_rl.transfer.judge import Judged

GOOD = 0.9
"""The share from which on a condition counts as passed."""
_HEAD = (
    "condition",
    "return",
    "of as trained",
    "upright",
    "effort",
    "speed",
    "power W",
    "jerk",
    "impact N",
)


@dataclass(frozen=True, kw_only=True)
class TransferCard:
    """The results of a policy under each condition.

    Attributes:
        policy: as it was named.
        task: its name.
        episodes: of each condition.
        seconds: of each episode, at most.
        trained: what the policy has met in its training, by the part of the task.
        judged: by the names of `CONDITIONS`.
        refused: why a condition cannot apply to the task, by its name.
    """

    policy: str
    task: str
    episodes: int
    seconds: float
    trained: Mapping[str, str]
    judged: Mapping[str, Judged]
    refused: Mapping[str, str]

    def __post_init__(self) -> None:
        """Refuse a card that leaves out a condition."""
        names = [condition.name for condition in CONDITIONS]
        for name in names:
            if (name in self.judged) == (name in self.refused):
                raise ValueError(
                    f"card: condition {name!r}: expected figures, or the reason why there are none"
                )

    @property
    def as_trained(self) -> Judged:
        """The result that the others are compared with."""
        return self.judged[CONDITIONS[0].name]

    def share(self, name: str) -> float:
        """Return the lesser of the shares of return and of upright episodes that a condition leaves; at least 0.

        Where the return as trained is not positive, it has no shares, and the share of episodes counts.
        """
        found = self.judged[name]
        shares = []
        if self.as_trained.return_mean > 0.0:
            shares.append(found.return_mean / self.as_trained.return_mean)
        if self.as_trained.upright > 0.0:
            shares.append(found.upright / self.as_trained.upright)
        return max(0.0, min(shares, default=0.0))

    @property
    def weakest(self) -> str:
        """The name of the condition with the least share."""
        return min(self.judged, key=self.share)

    def verdict(self) -> str:
        """Return the card in one line."""
        passed = sum(self.share(name) >= GOOD for name in self.judged)
        line = (
            f"{self.policy}: weakest under {self.weakest!r}, which leaves {self.share(self.weakest):.2f}; "
            f"{passed} of {len(self.judged)} conditions leave at least {GOOD:g}"
        )
        if self.refused:
            line += f"; {len(self.refused)} cannot apply to {self.task}"
        return line

    def page(self) -> str:
        """Return the card as Markdown."""
        errors = list(self.as_trained.errors)
        head = [*_HEAD, *errors]
        lines = [f"# Transfer card of {self.policy}", "", self.verdict(), ""]
        lines += [
            f"{self.task}, {self.episodes} episodes of each condition in MuJoCo's C engine, of {self.seconds:g} s at "
            "most, with the same starts and commands. Efforts (of the limit), joint speeds and impacts are 99th "
            "percentiles, jerk is a root mean square, power a mean.",
            "",
            "![shares of return and of upright episodes under each condition](card.png)",
            "",
            f"| {' | '.join(head)} |",
            f"|{'---|' * len(head)}",
        ]
        for condition in CONDITIONS:
            name = condition.name
            if name in self.refused:
                why = _cell(self.refused[name])
                lines.append(f"| {name} | cannot apply: {why} |{' |' * (len(head) - 2)}")
                continue
            found = self.judged[name]
            cells = [
                name,
                _short(found.return_mean),
                f"{self.share(name):.2f}",
                f"{found.upright:.0%}",
            ]
            felt = (found.effort, found.speed, found.power, found.jerk, found.impact)
            cells += [_short(value) for value in felt]
            cells += [_short(found.errors[error]) for error in errors]
            lines.append(f"| {' | '.join(cells)} |")
        lines += ["", "What it has met in training:", "", "| part | of the task |", "|---|---|"]
        lines += [f"| {_cell(part)} | `{_cell(text)}` |" for part, text in self.trained.items()]
        return "\n".join(map(printable, lines)) + "\n"

    def numbers(self) -> str:
        """Return the card as JSON, in which a figure that the task has none of is null."""
        judged = {name: _plain(asdict(found)) for name, found in self.judged.items()}
        tree = {
            "policy": self.policy,
            "task": self.task,
            "episodes": self.episodes,
            "seconds": self.seconds,
            "verdict": self.verdict(),
            "trained": dict(self.trained),
            "weakest": {"condition": self.weakest, "share": self.share(self.weakest)},
            "shares": {name: self.share(name) for name in self.judged},
            "judged": judged,
            "refused": dict(self.refused),
        }
        return json.dumps(tree, indent=1) + "\n"

    def write(self, folder: Path) -> None:
        """Write page, picture and numbers into a folder that is there: card.md, card.png and card.json."""
        write_whole(folder / "card.md", self.page())
        write_whole(folder / "card.json", self.numbers())
        self.draw(folder / "card.png")

    @plain_style()
    def draw(self, picture: Path) -> None:
        """Draw the shares under each condition into a PNG."""
        names = [condition.name for condition in CONDITIONS if condition.name in self.judged]
        shares = [self.share(name) for name in names]
        colors = np.where(np.array(shares) >= GOOD, "#3465a4", "#cc5500")
        figure = Figure(figsize=(7.5, 0.27 * len(names) + 1.2), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        places = range(len(names))
        axes.barh(places, shares, color=colors)
        axes.set_yticks(places, names, fontsize=8)
        axes.invert_yaxis()
        axes.axvline(GOOD, color="#888888", linewidth=0.8)
        axes.set_xlim(0.0, max(1.1, *shares))
        axes.set_xlabel("the lesser share of return and of upright episodes, of as trained")
        axes.set_title(f"{self.policy} ({self.task})", fontsize=10)
        figure.savefig(picture, dpi=110)


def _cell(text: str) -> str:
    """Return a text that stays in its cell of a table, whatever bars it has, as regular expressions do."""
    return text.replace("|", r"\|")


def _short(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def _plain(tree: Mapping[str, object]) -> dict[str, object]:
    """Return figures with null for those that there are none of."""
    found: dict[str, object] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found[name] = _plain(value)
        elif isinstance(value, float) and math.isnan(value):
            found[name] = None
        else:
            found[name] = value
    return found
