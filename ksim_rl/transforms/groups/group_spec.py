"""This module maps the terms of a group to their columns in its vector."""

from dataclasses import dataclass
from typing import Any

from tensordict import NestedKey

from ksim_rl import checks


@dataclass(frozen=True, kw_only=True)
class GroupSpec:
    """The map from terms to columns of one group vector.

    Args:
        name: the key of the vector.
        terms: keys of the terms, in order.
        sizes: their numbers of columns.
    """

    name: NestedKey
    terms: tuple[NestedKey, ...]
    sizes: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of columns of the vector."""
        return sum(self.sizes)

    def slice(self, term: NestedKey) -> slice:
        """Return the columns of `term`, given by its key or by the last part of it.

        Raises:
            ValueError: if no term has that name, or more than one.
        """
        found = [i for i, key in enumerate(self.terms) if key == term] or [
            i for i, key in enumerate(self.terms) if last_name(key) == term
        ]
        if not found:
            raise checks.unknown_name(f"term of group {self.name!r}", str(term), map(last_name, self.terms))
        if len(found) > 1:
            raise ValueError(f"group {self.name!r} has {len(found)} terms named {term!r}: give the whole key")
        start = sum(self.sizes[: found[0]])
        return slice(start, start + self.sizes[found[0]])

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for a checkpoint or an export: term name -> [start, stop)."""
        columns = {spell(key): self.slice(key) for key in self.terms}
        return {name: [found.start, found.stop] for name, found in columns.items()}


def last_name(key: NestedKey) -> str:
    """Return the last part of a key."""
    return key if isinstance(key, str) else str(key[-1])


def spell(key: NestedKey) -> str:
    """Return a key as one string."""
    return key if isinstance(key, str) else "/".join(map(str, key))
