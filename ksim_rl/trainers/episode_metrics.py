"""What the env says about episodes, as metrics."""

from collections.abc import Mapping

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.transforms.innermost import innermost


def read_episode_sums(env: EnvBase, rollout_ET: TensorDictBase) -> dict[str, Tensor]:
    """Return what happened in this rollout, each a tensor [] on the device, and start the env's sums anew.

    Any env gives the mean reward per step; one with an `episode_log` also its sums over the episodes that ended, and
    one with `curriculum_levels` and `command_levels` those.
    """
    sums = {"rollout/reward": rollout_ET.get(("next", "reward")).mean()}
    base_env = innermost(env)
    if hasattr(base_env, "episode_log"):
        # Copies, because the sums are cleared before they are read on the host.
        sums |= {f"sum/{name}": total.clone() for name, total in base_env.episode_log().items()}
        base_env.episode_log_reset_()
    if hasattr(base_env, "curriculum_levels"):
        sums |= {f"curriculum/{name}": level for name, level in base_env.curriculum_levels().items()}
    if hasattr(base_env, "command_levels"):
        sums |= {f"command/{name}": level for name, level in base_env.command_levels().items()}
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
