"""This module holds the base of all algorithms' settings, and what a run asks of them before anything is built."""

from dataclasses import dataclass
from typing import ClassVar, Self


@dataclass(frozen=True, kw_only=True)
class AlgorithmCfg:
    """The settings of an algorithm: a run's `objective`. A subclass of a registered one inherits its algorithm.

    Attributes:
        learns_on_sequences: whether networks may have a memory.
    """

    learns_on_sequences: ClassVar[bool] = False

    @property
    def observation_groups(self) -> tuple[str, ...]:
        """The observation groups that it reads beside those of the networks."""
        return ()

    def check_memory(self) -> None:
        """Refuse settings that networks with a memory do not allow.

        Raises:
            ValueError: naming the field and its value.
        """

    def with_absolute_paths(self) -> Self:
        """Return the same settings with paths that lead to the same files from any folder."""
        return self
