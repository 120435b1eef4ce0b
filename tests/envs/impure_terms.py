"""Terms that write what is not theirs, and an env of a puck that has one of them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ksim_rl.envs import EnvView, ManagerBasedRlEnv, ObservationGroupCfg, ObservationTermCfg
from ksim_rl.envs.term import (
    ActionTerm,
    CommandTerm,
    CurriculumTerm,
    EventTerm,
    MetricTerm,
    ObservationTerm,
    RewardTerm,
    TerminationTerm,
)
from ksim_rl.mdp import JointPos, JointPosRel, JointVel
from tests.envs.probe_env import Target, puck_cfg

Deed = Callable[[EnvView], Any]


@dataclass(frozen=True, kw_only=True)
class BadReward(RewardTerm):
    """Does `deed`, then returns ones."""

    deed: Deed

    def __call__(self, view: EnvView) -> Tensor:
        self.deed(view)
        return torch.ones(view.num_envs)


@dataclass(frozen=True, kw_only=True)
class BadObservation(ObservationTerm):
    """Does `deed`, then returns ones."""

    deed: Deed

    def __call__(self, view: EnvView) -> Tensor:
        self.deed(view)
        return torch.ones(view.num_envs, 1)


@dataclass(frozen=True, kw_only=True)
class BadTermination(TerminationTerm):
    """Does `deed`, and ends nothing."""

    deed: Deed

    def __call__(self, view: EnvView) -> Tensor:
        self.deed(view)
        return torch.zeros(view.num_envs, dtype=torch.bool)


@dataclass(frozen=True, kw_only=True)
class BadMetric(MetricTerm):
    """Does `deed`, then returns ones."""

    deed: Deed

    def __call__(self, view: EnvView) -> Tensor:
        self.deed(view)
        return torch.ones(view.num_envs)


@dataclass(frozen=True, kw_only=True)
class BadCommand(CommandTerm):
    """Does `deed` when its vector is computed."""

    deed: Deed
    resampling_time_range_s: tuple[float, float] | None = None

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        """Draw nothing."""

    def __call__(self, view: EnvView) -> Tensor:
        self.deed(view)
        return torch.ones(view.num_envs, 1)


@dataclass(frozen=True, kw_only=True)
class BadDraw(CommandTerm):
    """Does `deed` when it is drawn."""

    deed: Deed
    resampling_time_range_s: tuple[float, float] | None = None

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        self.deed(view)

    def __call__(self, view: EnvView) -> Tensor:
        return torch.ones(view.num_envs, 1)


@dataclass(frozen=True, kw_only=True)
class BadEvent(EventTerm):
    """Does `deed`, whatever its mask."""

    deed: Deed

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        self.deed(view)


@dataclass(frozen=True, kw_only=True)
class BadAction(ActionTerm):
    """Does `deed`."""

    deed: Deed

    def size(self, view: EnvView) -> int:
        return 1

    def __call__(self, view: EnvView, action_EK: Tensor) -> None:
        self.deed(view)


@dataclass(frozen=True, kw_only=True)
class BadCurriculum(CurriculumTerm):
    """Does `deed`."""

    deed: Deed

    def __call__(self, view: EnvView, mask_E: Tensor) -> Tensor:
        self.deed(view)
        return torch.zeros(())


TERMS = {
    "observations": BadObservation,
    "rewards": BadReward,
    "terminations": BadTermination,
    "metrics": BadMetric,
    "commands": BadCommand,
    "events": BadEvent,
    "actions": BadAction,
    "curriculum": BadCurriculum,
}


def env_with(kind: str, term: Any, **fields: Any) -> ManagerBasedRlEnv:
    """Build a puck's env in which `term` is called "bad" and stands among others that do no harm."""
    readings = {"position": JointPos(), "off": JointPosRel(), "velocity": JointVel()}
    if kind == "observations":
        readings["bad"] = term
    terms = {name: ObservationTermCfg(term=reading) for name, reading in readings.items()}
    group = ObservationGroupCfg(terms=terms)
    parts: dict[str, Any] = {
        "observations": {"actor": group, "critic": group},
        "commands": {"target": Target(resampling_time_range_s=(0.1, 0.2))},
    }
    if kind not in ("observations", "actions"):
        parts[kind] = parts.get(kind, {}) | {"bad": term}
    if kind == "actions":
        parts[kind] = {"bad": term}
    return ManagerBasedRlEnv(puck_cfg(limit=None, **(parts | fields)))
