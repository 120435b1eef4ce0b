"""This module counts on the device what the physics lost or could not compute, and explains it on the host."""

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Int64
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import SimulatedWorld, part

_OVERFLOW, _NAN = "overflow/", "nan/worlds"


@dataclass(frozen=True, kw_only=True)
class PhysicsReport:
    """What happened in the physics of one rollout.

    Attributes:
        metrics: shares and counts to log, `physics/<name>`.
        lost: one line for each kind of contacts or constraints that did not fit.
        saved: one line for each state that the NaN guard wrote to a file.
    """

    metrics: dict[str, float]
    lost: tuple[str, ...] = ()
    saved: tuple[str, ...] = ()


def read_physics(env: EnvBase) -> dict[str, Int64[Tensor, ""]]:
    """Return the counts of this rollout, each a tensor [] on the device, and start anew; none without a world."""
    simulated = part(env, SimulatedWorld)
    if simulated is None:
        return {}
    world = simulated.world
    counts = {f"{_OVERFLOW}{index}": count for index, count in enumerate(world.overflow_counts().unbind())}
    return counts | {_NAN: world.nan_count()}


def explain_physics(env: EnvBase, counts: Mapping[str, float]) -> PhysicsReport:
    """Say what the counts mean, which other metrics may stand beside; reads the device only if a world failed."""
    simulated = part(env, SimulatedWorld)
    if simulated is None:
        return PhysicsReport(metrics={})
    world = simulated.world
    numbers = [int(value) for name, value in counts.items() if name.startswith(_OVERFLOW)]
    overflow = world.explain_overflow(numbers)
    return PhysicsReport(
        metrics={f"physics/{name}": value for name, value in overflow.metrics.items()},
        lost=tuple(overflow.messages),
        saved=tuple(world.nan_report().messages) if counts[_NAN] else (),
    )


def without_counts(metrics: Mapping[str, float]) -> dict[str, float]:
    """Leave out what only `explain_physics` reads."""
    return {name: value for name, value in metrics.items() if not name.startswith((_OVERFLOW, _NAN))}
