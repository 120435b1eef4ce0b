"""`ksim-rl collect` writes whole episodes of a policy, or of an agent without one, into a folder."""

from datetime import datetime
from pathlib import Path

import torch

from ksim_rl.checks import OneLineParser, check_count
from ksim_rl.cli.errors import say
from ksim_rl.cli.report import shown, shown_working
from ksim_rl.data import check_lerobot, read_episodes, write_lerobot
from ksim_rl.files.writing import check_place
from ksim_rl.terminal import show
from ksim_rl.trainers.collecting import CollectCfg, collect_episodes
from ksim_rl.viewer.played import find
from ksim_rl.viewer.session import AGENTS

FOLDER = Path("datasets")
LEROBOT = "lerobot"
MOST_ENVS = 64


def collect(arguments: list[str]) -> int:
    """Run `ksim-rl collect <arguments>` and return its exit code."""
    options = _parser().parse_intermixed_args(arguments)
    check_count("--episodes", options.episodes)
    check_place("--output", options.output, is_folder=True)
    if options.num_envs is None:
        num_envs = min(options.episodes, MOST_ENVS)
    else:
        check_count("--num-envs", options.num_envs)
        num_envs = options.num_envs
    if options.lerobot:
        # Before anything is recorded.
        check_lerobot()
    how = CollectCfg(
        num_episodes=options.episodes,
        num_envs=num_envs,
        seed=options.seed,
        as_in_training=options.as_in_training,
    )
    # Everything that compiles or loads is inside, so that the wait is explained.
    with shown_working(f"collecting {options.episodes} episodes"):
        played = find(options.what, agent=options.agent, device=options.device)
        folder = options.output
        if folder is None:
            folder = FOLDER / played.cfg.task_name / f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
        contents, interrupt = collect_episodes(
            played.cfg, played.policy, folder, how, title=played.title, note=say
        )
        if options.lerobot and contents.num_episodes:
            write_lerobot(folder, folder / LEROBOT)
    if contents.num_episodes:
        show(f"{played.title}: {_summary(folder)}; {shown(folder)}")
    if interrupt.signal is None:
        return 0
    say(
        f"{interrupt.signal.name}: {contents.num_episodes} of {contents.asked} episodes are whole, in {shown(folder)}"
    )
    return 128 + int(interrupt.signal)


def _summary(folder: Path) -> str:
    """Describe the content of a folder of episodes."""
    found = read_episodes(folder)
    number_D = found.env_states_D["episode"]
    reward_D = found.env_states_D["next", "reward"].flatten().to(torch.float64)
    # One sum for each episode.
    returns = torch.zeros(found.contents.num_episodes, dtype=torch.float64)
    returns.index_add_(0, number_D, reward_D)
    size = found.contents.num_env_states
    num_bytes = size * sum(leaf.num_bytes for leaf in found.contents.leaves)
    std, mean = torch.std_mean(returns, correction=0)
    return (
        f"{len(returns):,} episodes, {size:,} env states, {num_bytes / 1e6:,.1f} MB, return {mean:.1f} +- {std:.1f}, "
        f"length {size / len(returns):.0f} steps"
    )


def _parser() -> OneLineParser:
    parser = OneLineParser(
        prog="ksim-rl collect",
        description="Write whole episodes of a policy, or with --agent of a task without one, into a folder.",
    )
    parser.add_argument(
        "what",
        nargs="+",
        metavar="RUN | zoo:NAME | task=NAME | field=value",
        help="a run folder or one of its checkpoints, or with --agent a task; then fields of its config to change",
    )
    parser.add_argument("--episodes", type=int, default=100, help="whole ones; default: 100")
    parser.add_argument(
        "--num-envs",
        type=int,
        help=f"at the same time; default: as many as episodes, and {MOST_ENVS} at most",
    )
    parser.add_argument(
        "--agent", choices=AGENTS, help="act without a policy: not at all, or at random"
    )
    parser.add_argument(
        "--as-in-training",
        action="store_true",
        help="drawn actions and noise on observations; default: deterministic actions, no noise",
    )
    parser.add_argument("--seed", type=int, default=0, help="of initial states and draws")
    parser.add_argument("--device", default="auto", help="cpu, cuda, cuda:<index> or auto")
    parser.add_argument(
        "--output", type=Path, help=f"a new folder; default: {FOLDER}/TASK/<date>_<time>"
    )
    parser.add_argument(
        "--lerobot",
        action="store_true",
        help=f"also write them as a dataset of LeRobot, into the subfolder {LEROBOT}",
    )
    return parser
