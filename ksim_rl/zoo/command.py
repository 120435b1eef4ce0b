"""The command `ksim-rl zoo`, which lists the policies that come with the package and adds one."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ksim_rl.checks import OneLineParser
from ksim_rl.terminal import show
from ksim_rl.zoo import adding
from ksim_rl.zoo.cards import FOLDER, cards, read_card, read_transfer

ROW = "{:<12}{:<26}{:>12}{:>10}{:>10}{:>9}  {}"

SHOWN = ("verdict", "weakest", "episodes", "seconds", "shares", "refused")
"""Of a transfer card; all its figures are in the file."""


def zoo(arguments: Sequence[str]) -> int:
    """List the policies, show one's card, or make an entry out of a run."""
    parser = OneLineParser(prog="ksim-rl zoo", description="List or add policies of the package.")
    parser.add_argument(
        "words", nargs="*", metavar="NAME | add RUN NAME", help="show a card, or make an entry"
    )
    parser.add_argument(
        "--folder", type=Path, default=FOLDER, help="of the zoo; default: the package's own"
    )
    parser.add_argument(
        "--episodes",
        type=int,
        default=100,
        help="of `add`, in our physics and in MuJoCo's C engine",
    )
    options: Any = parser.parse_args(arguments)
    match options.words:
        # Without words: the list.
        case []:
            show(
                ROW.format("name", "task", "env states", "return", "C engine", "weakest", "commit")
            )
            for card in cards(options.folder):
                if card.return_mean is None:
                    earned = "-"
                else:
                    earned = f"{card.return_mean:.4g}"
                ratio = f"x {card.sim2sim.get('return_ratio', float('nan')):.3f}"
                transfer = _transfer(card.name, options.folder)
                weakest = "-" if transfer is None else f"x {transfer['weakest']['share']:.2f}"
                # Seven letters of a commit are enough to find it.
                trained = (card.name, card.task, f"{card.env_states:,}", earned)
                show(ROW.format(*trained, ratio, weakest, card.commit[:7]))
            show(
                "weakest: what its transfer card leaves under the hardest condition, see docs/cards"
            )
            return 0
        case ["add", run, name]:
            card = adding.add(Path(run), name, folder=options.folder, episodes=options.episodes)
        case [name]:
            card = read_card(name, options.folder)
        case words:
            raise ValueError(f"{' '.join(words)}: expected NAME, or add RUN NAME")
    tree = asdict(card)
    transfer = _transfer(card.name, options.folder)
    if transfer is not None:
        tree["transfer"] = {key: transfer[key] for key in SHOWN}
    show(json.dumps(tree, indent=1))
    return 0


def _transfer(name: str, folder: Path) -> dict[str, Any] | None:
    """Return the numbers of a transfer card, which the package has of its own policies."""
    return read_transfer(name) if folder == FOLDER else None
