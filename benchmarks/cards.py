"""Judges the policies of the zoo under all conditions: the least share of each.

    python -m benchmarks.cards
    python -m benchmarks.cards --policies cartpole,go1 --episodes 32

The page and the picture of each go to docs/cards/<name>, its numbers to ksim_rl/zoo/transfer, where `ksim-rl zoo` finds
them. Figures go to benchmarks/results/cards.json: `zoo/<name>/weakest`, the least share over the list, with the name of
that condition and all shares beside it. A policy that fails somewhere says so.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from benchmarks import command_line, report
from ksim_rl.checks import OneLineParser, check_count, check_known
from ksim_rl.files.writing import whole_folder, write_whole
from ksim_rl.transfer.card import TransferCard
from ksim_rl.transfer.command import EPISODES, judge_all
from ksim_rl.transfer.judge import MOST_SECONDS
from ksim_rl.zoo.cards import FOLDER, TRANSFER, cards

PAGES = Path(__file__).parents[1] / "docs" / "cards"


def main() -> int:
    """Judge the policies, one after the other, and write each as soon as it is known."""
    names = [card.name for card in cards(FOLDER)]
    parser = OneLineParser(prog="python -m benchmarks.cards", description=__doc__)
    parser.add_argument("--policies", default=",".join(names), help="of the zoo; default: all")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="of each condition")
    parser.add_argument("--seconds", type=float, default=MOST_SECONDS, help="of each episode")
    options: Any = parser.parse_args()
    check_count("--episodes", options.episodes)
    for name in options.policies.split(","):
        check_known("policy", name, names)
        how = {"episodes": options.episodes, "seconds": options.seconds, "note": print}
        found = judge_all(FOLDER / name, name=f"zoo:{name}", **how)
        print(found.verdict())
        ship(found, name)
        report.write(
            "cards",
            figures={f"zoo/{name}/weakest": found.share(found.weakest)},
            device=torch.device("cpu"),
            module="benchmarks.cards",
            weakest={name: found.weakest},
            shares={name: {condition: found.share(condition) for condition in found.judged}},
            refused={name: dict(found.refused)},
            episodes={name: options.episodes},
            seconds={name: options.seconds},
        )
    return 0


def ship(found: TransferCard, name: str) -> None:
    """Write a card where a user of the zoo sees it: its page and picture in docs, its numbers in the package."""
    page = PAGES / name
    with whole_folder(page, below=PAGES.parent) as unfinished:
        found.write(unfinished)
        # Once in the repository: in the package, which has no pages.
        numbers = (unfinished / "card.json").read_text()
        (unfinished / "card.json").unlink()
    write_whole(TRANSFER / f"{name}.json", numbers)


if __name__ == "__main__":
    command_line.run(main)
