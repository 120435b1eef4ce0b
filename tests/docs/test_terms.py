"""The table of terms says what the terms' docstrings say. To write it anew: python -m tests.docs.test_terms."""

import dataclasses
import inspect
import math
from pathlib import Path

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

TERMS = Path(__file__).parents[2] / "docs" / "terms.md"
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
action or a command. Position- and velocity-stage values are those of the current state. Acceleration-stage ones
(contacts, efforts, accelerations) belong to the last physics substep, and read zero in rows that were just reset.
"""


def fields_of(term: type) -> str:
    """The term's own fields with their defaults; those of its kind (such as `weight`) are left out."""
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


def row(name: str) -> str:
    """One line of a table. Bars would end a cell, so they are escaped."""
    term = getattr(mdp, name)
    summary = " ".join(inspect.getdoc(term).split("\n\n")[0].split())
    return (
        "| " + " | ".join(cell.replace("|", r"\|") for cell in (f"`{name}`", summary, fields_of(term))) + " |"
    )


def page() -> str:
    parts = [HEAD]
    for title, kind in KINDS.items():
        names = [name for name in mdp.__all__ if issubclass(getattr(mdp, name), kind)]
        parts.append(
            "\n".join([f"## {title}", "", "| term | what | fields |", "|---|---|---|", *map(row, names)])
        )
    return "\n\n".join(part.strip() for part in parts) + "\n"


def test_the_table_of_terms_lists_all_terms_as_they_are():
    written = TERMS.read_text().splitlines()
    names = [line.split("`")[1] for line in written if line.startswith("| `")]
    assert sorted(names) == mdp.__all__
    assert written == page().splitlines(), "docs/terms.md is out of date: python -m tests.docs.test_terms"


if __name__ == "__main__":
    TERMS.write_text(page())
