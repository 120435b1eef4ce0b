"""Seeded choices that know what a model was asked to have, and keep what it was given."""

from collections.abc import Iterable, Sequence

import numpy as np


class Draw:
    """Random choices of one model.

    Args:
        rng: where they come from.
        wanted: the features that the model shall have, where it can; all others come by chance.
        barred: the begins of the names of features that it shall not have.

    Attributes:
        taken: the features that it was given.
    """

    def __init__(
        self, rng: np.random.Generator, wanted: Iterable[str] = (), barred: tuple[str, ...] = ()
    ) -> None:
        self.rng = rng
        self.wanted = frozenset(wanted)
        self.barred = barred
        self.taken: set[str] = set()

    def takes(self, feature: str, chance: float) -> bool:
        """Whether an element has a feature: the first if it is wanted, the others by chance."""
        # Drawn in any case, so that what is wanted does not change all that follows.
        by_chance = bool(self.rng.random() < chance)
        is_due = feature in self.wanted and feature not in self.taken
        if feature.startswith(self.barred) or not (is_due or by_chance):
            return False
        self.taken.add(feature)
        return True

    def wants_some_of(self, family: str) -> bool:
        """Whether some feature of a family is wanted."""
        return any(name.startswith(f"{family}.") for name in self.wanted)

    def kinds(self, family: str, choices: Sequence[str], count: int) -> list[str]:
        """Draw `count` members of a family, all that are wanted among them."""
        choices = self.allowed(family, choices)
        wanted = [choice for choice in choices if f"{family}.{choice}" in self.wanted]
        by_chance = [str(choice) for choice in self.rng.choice(choices, size=count)]
        found = (wanted + by_chance)[: max(count, len(wanted))]
        self.taken.update(f"{family}.{choice}" for choice in found)
        return found

    def kind(self, family: str, choices: Sequence[str]) -> str:
        """Draw a member of a family, first those that are wanted."""
        choices = self.allowed(family, choices)
        due = [choice for choice in choices if f"{family}.{choice}" in self.wanted - self.taken]
        found = str(self.rng.choice(due or list(choices)))
        self.taken.add(f"{family}.{found}")
        return found

    def allowed(self, family: str, choices: Sequence[str]) -> list[str]:
        """Return the members of a family that are not barred."""
        return [choice for choice in choices if not f"{family}.{choice}".startswith(self.barred)]

    def any(self, names: Sequence[str]) -> str:
        """Draw one of some names."""
        return names[int(self.rng.integers(len(names)))]

    def number(self, low: float, high: float) -> str:
        """Draw a number, as XML has it."""
        return f"{self.rng.uniform(low, high):.4g}"

    def numbers(self, low: float, high: float, count: int) -> str:
        """Draw numbers, as XML has them."""
        return written(self.rng.uniform(low, high, size=count))

    def axis(self) -> str:
        """Draw a direction: often an axis, else any."""
        if self.rng.random() < 0.5:
            return written(np.eye(3)[self.rng.integers(3)])
        direction = self.rng.normal(size=3)
        return written(direction / np.linalg.norm(direction))

    def quat(self, turn: float = 1.0) -> str:
        """Draw an orientation: any, or near to none where `turn` is small."""
        quat = np.array([1.0, 0.0, 0.0, 0.0]) + turn * self.rng.normal(size=4)
        return written(quat / np.linalg.norm(quat))


def written(values: Iterable[float]) -> str:
    """Return numbers as XML has them."""
    return " ".join(f"{value:.4g}" for value in values)
