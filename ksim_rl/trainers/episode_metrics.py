"""This module turns what an env says about episodes into metrics."""

from collections.abc import Mapping

from jaxtyping import Num
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import DifficultyLevels, EpisodeSums, part


def read_episode_sums(env: EnvBase, rollout_ET: TensorDictBase) -> dict[str, Num[Tensor, ""]]:
    """Return what happened in this rollout, each a tensor [] on the device, and start the env's sums anew.

    Any env gives the mean reward per step; one with `EpisodeSums` also its sums over the episodes that ended, and one
    with `DifficultyLevels` those.
    """
    sums = {"rollout/reward": rollout_ET.get(("next", "reward")).mean()}
    if (episodes := part(env, EpisodeSums)) is not None:
        # Copies, because the sums are cleared before they are read on the host.
        sums |= {f"sum/{name}": total.clone() for name, total in episodes.episode_log().items()}
        episodes.episode_log_reset_()
    if (levels := part(env, DifficultyLevels)) is not None:
        sums |= {f"curriculum/{name}": level for name, level in levels.curriculum_levels().items()}
        sums |= {f"command/{name}": level for name, level in levels.command_levels().items()}
    return sums


def episode_means(sums: Mapping[str, float], *, max_episode_length_s: float) -> dict[str, float]:
    """Turn sums over episodes into means per episode; without a finished episode those are left out.

    `episode/return`, `episode/length` (env steps) and `metric/<name>` are means. `termination/<name>` is a share of
    episodes. `reward/<term>` is the weighted sum over an episode, per second of the longest possible episode (or as it
    is where episodes have no limit), so that a term of weight w that is always 1 reads w.
    """
    metrics = {name: value for name, value in sums.items() if not name.startswith("sum/")}
    episodes = sums.get("sum/episodes")
    if episodes is None:
        return metrics
    metrics["episode/count"] = episodes
    metrics["episode/non_finite"] = sums.get("sum/termination/non_finite", 0.0)
    if episodes == 0.0:
        return metrics
    metrics["episode/return"] = sums["sum/return_sum"] / episodes
    metrics["episode/length"] = sums["sum/length_sum"] / episodes
    for name, total in sums.items():
        room, _, term = name.removeprefix("sum/").partition("/")
        if room == "reward":
            metrics[f"reward/{term}"] = total / episodes / (max_episode_length_s or 1.0)
        elif room in ("termination", "metric"):
            metrics[f"{room}/{term}"] = total / episodes
    return metrics
