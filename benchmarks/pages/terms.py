"""Makes docs/terms.md from the docstrings and fields of the terms."""

import dataclasses
import inspect
import math

from benchmarks.pages.table import table
from ksim_rl import mdp
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

KINDS = {
    "Observations": ObservationTerm,
    "Actions": ActionTerm,
    "Commands": CommandTerm,
    "Rewards": RewardTerm,
    "Terminations": TerminationTerm,
    "Events": EventTerm,
    "Curricula": CurriculumTerm,
    "Metrics": MetricTerm,
}
HEAD = """# Terms

All terms of `ksim_rl.envs.mdp`, by kind: what each gives, with shape, unit, frame and stage, and its fields. Fields
without a value must be given. The docstring of a term says more: `help(mdp.TrackLinearVelocity)`.

Dims: `E` envs, `L` joints or other elements of a vector, `N` bodies, geoms or contacts, `F` feet, `K` columns of an
action or a command. Position- and velocity-stage values belong to the current state. Acceleration-stage ones
(contacts, efforts, accelerations) belong to the last physics substep, and read zero in rows that were just reset.
"""


def fields_of(term: type) -> str:
    """The term's own fields with their defaults; fields that all terms of its kind have (`weight`) are left out."""
    kind = next(kind for kind in KINDS.values() if issubclass(term, kind))
    common = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    parts = []
    for field in dataclasses.fields(term):  # type: ignore[arg-type]
        if field.name in common:
            continue
        if field.default is not dataclasses.MISSING:
            parts.append(f"`{field.name}={field.default!r}`".replace(repr(math.pi), "pi"))
        elif field.default_factory is not dataclasses.MISSING:
            parts.append(f"`{field.name}={field.default_factory()!r}`")
        else:
            parts.append(f"`{field.name}`")
    return ", ".join(parts)


def row(name: str) -> list[str]:
    """Return the cells of a term: its name, the first paragraph of its docstring, and its fields."""
    term = getattr(mdp, name)
    text = inspect.getdoc(term) or ""
    summary = text.split("\n\n")[0]
    return [f"`{name}`", " ".join(summary.split()), fields_of(term)]


def page() -> str:
    """Return the page: a table for each kind of term."""
    parts = [HEAD]
    for title, kind in KINDS.items():
        names = [name for name in mdp.__all__ if issubclass(getattr(mdp, name), kind)]
        rows = [row(name) for name in names]
        parts.append(f"## {title}\n\n{table(('term', 'what', 'fields'), rows)}")
    return "\n\n".join(part.strip() for part in parts) + "\n"
