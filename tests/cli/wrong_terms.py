"""Terms of users that return or raise what they should not."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from ksim_rl.envs import ManagerBasedRlEnvCfg, MetricTerm
from ksim_rl.envs.term import ObservationTerm, RewardTerm, TerminationTerm
from ksim_rl.transforms import ObservationTermCfg

Change = Callable[[ManagerBasedRlEnvCfg], ManagerBasedRlEnvCfg]


def _answer(given: Any) -> Any:
    if isinstance(given, BaseException):
        raise given
    return given


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reward(RewardTerm):
    """Returns what it was given, or raises it."""

    given: object = None

    def __call__(self, view):
        return _answer(self.given)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Termination(TerminationTerm):
    """Returns what it was given, or raises it."""

    given: object = None

    def __call__(self, view):
        return _answer(self.given)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metric(MetricTerm):
    """Returns what it was given, or raises it."""

    given: object = None

    def __call__(self, view):
        return _answer(self.given)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Observation(ObservationTerm):
    """Returns what it was given, or raises it."""

    given: object = None

    def __call__(self, view):
        return _answer(self.given)


# For two envs.
ANSWERS: dict[str, Any] = {
    "None": None,
    "a float": 1.0,
    "a list": [1.0, 2.0],
    "a text": "a",
    "an array": np.ones(2),
    "three envs": torch.ones(3),
    "no env": torch.tensor(1.0),
    "nothing": torch.ones(0),
    "two matrices": torch.ones(2, 2, 2),
    "complex numbers": torch.ones(2, dtype=torch.complex64),
    "other device": torch.ones(2, device="meta"),
    "raises KeyError": KeyError("own"),
    "raises ZeroDivisionError": ZeroDivisionError("own"),
    "raises SystemExit": SystemExit(0),
    "raises StopIteration": StopIteration(),
    "raises AssertionError": AssertionError(),
}


def _with_reward(given: Any) -> Change:
    return lambda cfg: dataclasses.replace(cfg, rewards={"riddle": Reward(given=given)})


def _with_termination(given: Any) -> Change:
    return lambda cfg: dataclasses.replace(cfg, terminations={"riddle": Termination(given=given)})


def _with_metric(given: Any) -> Change:
    return lambda cfg: dataclasses.replace(cfg, metrics={"riddle": Metric(given=given)})


def _with_observation(given: Any) -> Change:
    def change(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
        terms = {"riddle": ObservationTermCfg(term=Observation(given=given))}
        return dataclasses.replace(
            cfg, observations={"actor": dataclasses.replace(cfg.observations["actor"], terms=terms)}
        )

    return change


KINDS = {
    "reward": _with_reward,
    "termination": _with_termination,
    "metric": _with_metric,
    "observation": _with_observation,
}


def changes() -> Iterator[tuple[str, str, Change]]:
    """Yield a name, what the error names, and the change of a task, for each kind of term and each wrong answer."""
    for kind, make in KINDS.items():
        for answer, given in ANSWERS.items():
            yield f"{kind}: {answer}", "riddle", make(given)
