"""The parts of an env that trainers, collectors, evaluators and adapters may use.

An env is a TorchRL `EnvBase` of batch size [E] whose roots and steps are EnvStates: that is enough to train. The
parts below are optional. An env has a part if it is an instance of its class, by inheritance or by
`Part.register(MyEnv)`; `ManagerBasedRlEnv` has all of them. `part(env, EpisodeClock)` finds a part in any env,
however it is wrapped; other modules find out in no other way what kind of env they were given.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, TypeVar

import numpy as np
from jaxtyping import Float, Int64
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.physics import World
from ksim_rl.transforms.innermost import EpisodeLimit, innermost

Part = TypeVar("Part")


class EpisodeClock(EpisodeLimit):
    """How long steps and episodes are.

    Seconds of one env step; seconds, and `max_episode_length` env steps, after which an episode is cut, 0 for never;
    and env steps since each episode's start, in one tensor that is written in place.
    """

    without: ClassVar[str] = (
        "no episode clock: videos and staggered episodes are off, and episodes count as unlimited"
    )

    @property
    @abstractmethod
    def step_dt(self) -> float: ...  # noqa: D102

    @property
    @abstractmethod
    def max_episode_length_s(self) -> float: ...  # noqa: D102

    @property
    @abstractmethod
    def episode_step_E(self) -> Int64[Tensor, " E"]: ...  # noqa: D102

    @abstractmethod
    def stagger_episodes_(self) -> None:
        """Let the running episodes time out at random steps, so that not all envs end together."""


class EpisodeSums(ABC):
    """Sums over finished episodes, kept on the device until they are read."""

    without: ClassVar[str] = "no sums over episodes: returns and lengths come from evaluation only"

    @abstractmethod
    def episode_log(self) -> dict[str, Float[Tensor, ""]]:
        """Return `episodes`, `length_sum`, `return_sum`, `reward/<term>`, `termination/<term>`, `metric/<name>`."""

    @abstractmethod
    def episode_log_reset_(self) -> None:
        """Start the sums again at 0."""

    def non_finite_terms(self) -> Sequence[str]:
        """Return a line for each term that gave a number that is not finite, as `non_finite_terms` counts them."""
        return ()


class DifficultyLevels(ABC):
    """The present levels of curricula."""

    without: ClassVar[str] = "no curricula: nothing about difficulty is logged"

    @abstractmethod
    def curriculum_levels(self) -> dict[str, Float[Tensor, ""]]:
        """Return the latest level of each curriculum."""

    @abstractmethod
    def command_levels(self) -> dict[str, Float[Tensor, ""]]:
        """Return the ranges that commands are drawn from now, `<command>/<field>_low` and `<command>/<field>_high`."""


class SimulatedWorld(ABC):
    """The physics, for reports: overflows of contacts and constraints, and states that were not finite."""

    without: ClassVar[str] = (
        "no physics world: contacts that did not fit and states that were not finite go unseen"
    )
    world: World


class Pictures(ABC):
    """Pictures of the current state, in the mode that the env was built with."""

    # Each `without` completes the line "<class> has ..." at the start of a run.
    without: ClassVar[str] = "no pictures: videos are off"
    render_mode: str | None

    @abstractmethod
    def render(self) -> np.ndarray | None:
        """Return a picture, uint8 [H, W, 3], or None without a render mode."""


PARTS = (EpisodeClock, EpisodeSums, DifficultyLevels, SimulatedWorld, Pictures)


def part(env: EnvBase, kind: type[Part]) -> Part | None:
    """Return the env inside all wrappers if it has the part `kind` (or is of this class), else None."""
    # Wrappers add no parts of their own, so only the innermost env is asked.
    inner = innermost(env)
    return inner if isinstance(inner, kind) else None


def missing_parts(env: EnvBase) -> list[str]:
    """Return one line for each part that the env lacks, with the consequence for a run."""
    name = type(innermost(env)).__name__
    return [f"{name} has {kind.without}" for kind in PARTS if part(env, kind) is None]
