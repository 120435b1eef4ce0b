"""Reads metrics from env and physics on the device, copies them to the host together, and explains them there."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64, Num, Shaped
from tensordict import TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import DifficultyLevels, EpisodeSums, SimulatedWorld, part
from ksim_rl.envs.signal_keys import signal_keys

_OVERFLOW = "overflow/"
_NAN = "nan/worlds"
# Over the ranks these are added up, or the most of them counts; of all others it is the mean.
ADDED = ("sum/", _NAN, "update/non_finite_env_states", "replay/")
MOST = (_OVERFLOW,)


@dataclass(frozen=True)
class PendingMetrics:
    """Metrics whose copy to the host may still be under way."""

    names: tuple[str, ...]
    values_M: Float64[Tensor, " M"]
    copied: torch.cuda.Event | None = None

    def read(self) -> dict[str, float]:
        """Wait for the copy, and return the metrics by name."""
        if self.copied is not None:
            self.copied.synchronize()
        return dict(zip(self.names, self.values_M.tolist(), strict=True))


def start_copy(
    metrics: Mapping[str, Shaped[Tensor, ""]], *, device: torch.device
) -> PendingMetrics:
    """Begin to copy 0-dim tensors to the host, as one vector.

    On CUDA the copy goes to pinned memory and does not wait for the device: work that is queued after it may start
    before the host reads.
    """
    if not metrics:
        return PendingMetrics((), torch.zeros(0, dtype=torch.float64))
    # Grouped by dtype, so that each group is stacked and converted by one kernel.
    of_kind: dict[torch.dtype, dict[str, Tensor]] = {}
    for name, value in metrics.items():
        of_kind.setdefault(value.dtype, {})[name] = value.detach().reshape(())
    # The order of the vector: by dtype, not the order of the argument.
    names = tuple(itertools.chain(*of_kind.values()))
    # float64 holds every count of env states exactly. One by one, a conversion each, took a kernel each.
    parts = []
    for of_dtype in of_kind.values():
        parts.append(torch.stack(list(of_dtype.values())).to(torch.float64))
    values_M = torch.cat(parts)
    if device.type != "cuda":
        return PendingMetrics(names, values_M)
    on_host_M = torch.empty(values_M.shape, dtype=values_M.dtype, pin_memory=True)
    on_host_M.copy_(values_M, non_blocking=True)
    # Marks the end of the copy in the stream, for `read` to wait for.
    copied = torch.cuda.Event()
    copied.record(torch.cuda.current_stream(device))
    return PendingMetrics(names, on_host_M, copied)


def read_episode_sums(env: EnvBase, rollout_ET: TensorDictBase) -> dict[str, Num[Tensor, ""]]:
    """Return the sums over this rollout, each a tensor [] on the device, and start the env's sums again at 0.

    Any env gives the mean reward per step; one with `EpisodeSums` also its sums over the episodes that ended, and one
    with `DifficultyLevels` those.
    """
    sums = {"rollout/reward": rollout_ET.get(unravel_key(("next", signal_keys(env).reward))).mean()}
    if (episodes := part(env, EpisodeSums)) is not None:
        # A copy, because the sums are cleared before they are read on the host.
        log = episodes.episode_log()
        # One kernel for the copy of all sums.
        totals = torch.stack([*log.values()]).unbind()
        sums |= {f"sum/{name}": total for name, total in zip(log, totals, strict=True)}
        episodes.episode_log_reset_()
    if (levels := part(env, DifficultyLevels)) is not None:
        sums |= {f"curriculum/{name}": level for name, level in levels.curriculum_levels().items()}
        sums |= {f"command/{name}": level for name, level in levels.command_levels().items()}
    return sums


def episode_means(sums: Mapping[str, float], *, max_episode_length_s: float) -> dict[str, float]:
    """Turn sums over episodes into means per episode; without a finished episode those are left out.

    Other metrics stay, except for the counts of `read_physics`.

    `episode/return`, `episode/length` (env steps) and `metric/<name>` are means. `termination/<name>` is a share of
    episodes. `reward/<term>` is the weighted sum over an episode, per second of the longest possible episode (or as it
    is where episodes have no limit), so that a term of weight w that is always 1 reads w.
    """
    metrics = {
        name: value
        for name, value in sums.items()
        if not name.startswith(("sum/", _OVERFLOW, _NAN))
    }
    episodes = sums.get("sum/episodes")
    if episodes is None:
        return metrics
    metrics["episode/count"] = episodes
    metrics["episode/non_finite"] = sums.get("sum/termination/non_finite", 0.0)
    # No episode has ended: means do not exist, and are left out rather than set to 0.
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


@dataclass(frozen=True, kw_only=True)
class PhysicsReport:
    """Overflows and failures in the physics of one rollout."""

    metrics: dict[str, float]  # shares and counts to log, `physics/<name>`
    lost: tuple[str, ...] = ()  # one line for each kind of contacts or constraints that did not fit
    saved: tuple[str, ...] = ()  # one line for each state that the NaN guard wrote to a file


def read_physics(env: EnvBase) -> dict[str, Int64[Tensor, ""]]:
    """Return the counts of this rollout, each a tensor [] on the device, and clear them; none without a world."""
    simulated = part(env, SimulatedWorld)
    if simulated is None:
        return {}
    world = simulated.world
    counts = {
        f"{_OVERFLOW}{index}": count for index, count in enumerate(world.overflow_counts().unbind())
    }
    return counts | {_NAN: world.nan_count()}


def explain_physics(env: EnvBase, counts: Mapping[str, float]) -> PhysicsReport:
    """Explain the counts, among which may be other metrics; reads the device only if a world failed."""
    simulated = part(env, SimulatedWorld)
    if simulated is None:
        return PhysicsReport(metrics={})
    world = simulated.world
    # In the order in which `read_physics` has numbered them.
    numbers = [int(value) for name, value in counts.items() if name.startswith(_OVERFLOW)]
    overflow = world.explain_overflow(numbers)
    return PhysicsReport(
        metrics={f"physics/{name}": value for name, value in overflow.metrics.items()},
        lost=tuple(overflow.messages),
        saved=tuple(world.nan_report().messages) if counts[_NAN] else (),
    )


@dataclass(frozen=True, kw_only=True)
class Losses:
    """Contacts and constraints that found no room: a line for each kind, and in how many worlds, at least."""

    lines: tuple[str, ...] = ()
    worlds: int = 0


def losses_of(env: EnvBase) -> Losses:
    """Return the contacts and constraints that were lost since the last look; reads the device."""
    simulated = part(env, SimulatedWorld)
    if simulated is None:
        return Losses()
    world = simulated.world
    report = world.explain_overflow(world.overflow_counts().tolist())
    return Losses(lines=tuple(report.messages), worlds=report.lost_worlds)
