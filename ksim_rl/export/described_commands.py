"""Describes the commands of an env: how many numbers each has, and the ranges that its policy has seen."""

from collections.abc import Iterable

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.envs.term import CommandRanges, CommandTerm, CurriculumTerm, hull
from ksim_rl.export.standalone.description import CommandSpec


def described_commands(
    ours: ManagerBasedRlEnv, curriculum: Iterable[CurriculumTerm], step_count: int
) -> dict[str, CommandSpec]:
    """Return size, kind and range of each command, by name.

    `low` and `high` have a number for each column, and are null where the term does not know its bounds. They hold the
    ranges that a curriculum has given within `step_count` env steps, too.
    """
    terms = list(curriculum)
    found: dict[str, CommandSpec] = {}
    for name, value in ours.command_manager.values.items():
        term = ours.cfg.commands[name]
        bounds = term.bounds(ours.view, _seen(name, term, terms, step_count))
        found[name] = {
            "size": value.shape[-1],
            "kind": type(term).__name__,
            "low": None if bounds is None else [float(low) for low, _ in bounds],
            "high": None if bounds is None else [float(high) for _, high in bounds],
        }
    return found


def _seen(
    name: str, term: CommandTerm, curriculum: Iterable[CurriculumTerm], step_count: int
) -> CommandRanges:
    """Return the widest range of each field that a training has drawn from."""
    seen = {field: [pair] for field, pair in term.ranges.items()}
    for adapts in curriculum:
        for ranges in adapts.command_ranges(step_count).get(name, ()):
            for field, pair in ranges.items():
                seen[field].append(pair)
    return {field: hull(pairs) for field, pairs in seen.items()}
