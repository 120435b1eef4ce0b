"""`ksim-rl card` judges a policy under all conditions, and writes its transfer card."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ksim_rl.checks import OneLineParser, check_count, check_in_range
from ksim_rl.files.writing import check_place, whole_folder
from ksim_rl.terminal import show
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.run_cfg import check_run_tree
from ksim_rl.trainers.run_folder import policy_of
from ksim_rl.transfer.card import GOOD, TransferCard
from ksim_rl.transfer.conditions import CONDITIONS
from ksim_rl.transfer.judge import MOST_SECONDS, Judged, judge
from ksim_rl.transfer.training_conditions import training_conditions
from ksim_rl.zoo import locate

EPISODES = 32


def card(arguments: Sequence[str]) -> int:
    """Write the card of a policy; the code is 1 where a condition leaves less than `card.GOOD`."""
    parser = OneLineParser(
        prog="ksim-rl card",
        description="Judge a policy under all that it may meet on a robot, in MuJoCo's C engine, on the CPU.",
    )
    parser.add_argument(
        "run", metavar="RUN", help="a run folder, one of its checkpoints, or zoo:NAME"
    )
    parser.add_argument(
        "--episodes", type=int, default=EPISODES, help=f"of each condition; default: {EPISODES}"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=MOST_SECONDS,
        help=f"of each episode; default: {MOST_SECONDS:g}",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="default: card in the run folder"
    )
    options: Any = parser.parse_args(arguments)
    check_count("--episodes", options.episodes)
    check_place("--output", options.output, is_folder=True)
    check_in_range("--seconds", options.seconds, low=0.0, low_open=True)
    run = locate(options.run)
    how = {"episodes": options.episodes, "seconds": options.seconds, "note": show}
    found = judge_all(run, name=str(options.run), **how)
    folder = options.output or run / "card"
    with whole_folder(folder, below=folder.parent) as unfinished:
        found.write(unfinished)
    show(found.verdict())
    show(f"{folder / 'card.md'}: the page, with card.png and card.json")
    return int(found.share(found.weakest) < GOOD)


def judge_all(
    run: Path,
    *,
    name: str,
    episodes: int,
    seconds: float = MOST_SECONDS,
    note: Callable[[str], None] = lambda _: None,
) -> TransferCard:
    """Return the card of a run's newest policy."""
    saved = checkpoint.load_latest(run)
    check_run_tree(saved.config, saved.path)
    policy = policy_of(saved, device="cpu")
    judged: dict[str, Judged] = {}
    refused: dict[str, str] = {}
    for number, condition in enumerate(CONDITIONS, 1):
        try:
            found = judge(policy.cfg, policy.actor, condition, episodes=episodes, seconds=seconds)
        except ValueError as error:
            # As trained it must run; other conditions may not apply to the task, as friction to a pole.
            if number == 1:
                raise
            refused[condition.name] = " ".join(str(error).split())
            note(
                f"{number}/{len(CONDITIONS)} {condition.name}: cannot apply: {refused[condition.name]}"
            )
            continue
        judged[condition.name] = found
        note(
            f"{number}/{len(CONDITIONS)} {condition.name}: return {found.return_mean:.4g}, {found.upright:.0%} upright"
        )
    return TransferCard(
        policy=name,
        task=policy.cfg.task_name,
        episodes=episodes,
        seconds=seconds,
        trained=training_conditions(policy.cfg.task),
        judged=judged,
        refused=refused,
    )
