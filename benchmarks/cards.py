"""Judges the policies of the zoo under all conditions: the least share of each.

    python -m benchmarks.cards
    python -m benchmarks.cards --policies cartpole,go1 --episodes 32

Figures go to benchmarks/results/cards.json: `zoo/<name>/weakest`, the least share over the list, with the name of that
condition and all shares beside it. A policy that fails somewhere says so.
"""

from __future__ import annotations

from typing import Any

import torch

from benchmarks import command_line, report
from ksim_rl.checks import OneLineParser, check_count, check_known
from ksim_rl.transfer.command import EPISODES, judge_all
from ksim_rl.transfer.judge import MOST_SECONDS
from ksim_rl.zoo.cards import FOLDER, cards


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


if __name__ == "__main__":
    command_line.run(main)
