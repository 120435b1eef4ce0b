"""Finds fields that a curriculum replaces while an env runs, and what else would write them."""

import sys
from collections.abc import Collection, Iterator, Mapping, Sequence

from ksim_rl.config import config_tree
from ksim_rl.config.overrides import given_fields
from ksim_rl.config.trees import Plain
from ksim_rl.envs.term import CurriculumTerm

PATH = "task"


def check_not_replaced(
    curricula: Mapping[str, CurriculumTerm],
    overrides: Sequence[str],
    given_before: Sequence[str] = (),
) -> None:
    """Refuse overrides of fields whose values a curriculum replaces, unless they are of the curriculum as well.

    Args:
        curricula: the task's, with the overrides.
        overrides: Hydra's, such as "task.commands.twist.lin_vel_x=[0,1]".
        given_before: fields of curricula that the user has overridden in the run that goes on, such as
            "task.curriculum.ranges.stages.9.lin_vel_x".

    Raises:
        ValueError: naming the field, the curriculum, and how to go without it.
    """
    check_given(curricula, given_fields(overrides), given_before)


def check_given(
    curricula: Mapping[str, CurriculumTerm], given: Sequence[str], given_before: Sequence[str]
) -> None:
    """Do the same for fields that were given values, be it by overrides or in a file."""
    for name, term in curricula.items():
        curriculum = f"{PATH}.curriculum.{name}"
        every = set(_replaced(term))
        of_curriculum = [field for field in (*given, *given_before) if _is_in(field, curriculum)]
        for replaced in sorted(every):
            # The user describes what the curriculum does with the field, and so knows of it.
            if any(not _is_of_others(field, replaced, every) for field in of_curriculum):
                continue
            for field in given:
                if _is_in(field, f"{PATH}.{replaced}"):
                    raise ValueError(
                        f"{field}: the curriculum {name!r} replaces {PATH}.{replaced} in training: leave it out, "
                        f"~{curriculum}, or override its values too"
                    )


def overridden_curricula(
    curricula: Mapping[str, CurriculumTerm], defaults: Mapping[str, CurriculumTerm]
) -> list[str]:
    """Return the fields in which curricula differ from a task's own: "task.curriculum.ranges.stages.9.lin_vel_x"."""
    trees = (config_tree.to_tree(terms) for terms in (curricula, defaults))
    return list(_differing(f"{PATH}.curriculum", *trees))


def _differing(path: str, tree: Plain, other: Plain) -> Iterator[str]:
    if not isinstance(tree, dict) or not isinstance(other, dict):
        if tree != other:
            yield path
        return
    for name, value in tree.items():
        yield from _differing(f"{path}.{name}", value, other.get(name))


def check_one_writer(curricula: Mapping[str, CurriculumTerm]) -> None:
    """Refuse two curricula that write one field: the later one would hide the earlier one.

    Raises:
        ValueError: naming the field and both curricula.
    """
    writers: dict[str, str] = {}
    for name, term in curricula.items():
        # Stages of a reward or termination are whole terms, so that two sets of stages cannot be joined.
        staged = {scope.replace("/", ".") for scope in term.adapted_fields}
        fields = {*_replaced(term), *staged}
        for field in sorted(fields):
            if field in writers:
                raise ValueError(
                    f"curriculum: {writers[field]!r} and {name!r} both write {field}: join them into one, or leave one "
                    "of them out"
                )
            writers[field] = name


def _replaced(term: CurriculumTerm) -> Iterator[str]:
    """Yield the fields that a curriculum writes, such as "commands.twist.lin_vel_x"."""
    for reward in term.adapted_rewards:
        yield f"rewards.{reward}.weight"
    for scope, stages in term.adapted_fields.items():
        for fields in stages:
            for field in fields:
                yield f"{scope.replace('/', '.')}.{field}"
    # Of all stages, however late they begin.
    for command, stages in term.command_ranges(sys.maxsize).items():
        for ranges in stages:
            for field in ranges:
                yield f"commands.{command}.{field}"


def _is_of_others(field: str, replaced: str, every: Collection[str]) -> bool:
    """Tell whether a field of a curriculum, such as "stages.9.ang_vel_z", names other replaced fields than this one."""
    parts = set(field.split("."))
    names = {one.rpartition(".")[2] for one in every} & parts
    return bool(names) and replaced.rpartition(".")[2] not in names


def _is_in(field: str, path: str) -> bool:
    return field == path or field.startswith(f"{path}.")
