"""Checks Hydra overrides against a config tree before anything is composed."""

import copy
import string
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override
from hydra.errors import HydraException
from omegaconf import OmegaConf

from ksim_rl.checks import near
from ksim_rl.config.class_paths import TARGET
from ksim_rl.config.trees import Plain, Tree

# Letters that a value of one word may hold without quotes.
UNQUOTED = frozenset(string.ascii_letters + string.digits + "_/.:+-%*@?")


def check_overrides(tree: Tree, overrides: Sequence[str]) -> None:
    """Refuse overrides that do not parse, or change a field which the tree does not have, with the near names there."""
    parsed = []
    for text in overrides:
        try:
            parsed.append(OverridesParser.create().parse_override(text))
        except HydraException as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"override {text!r} does not parse: {reason}{quoting(text)}") from None
    check_parsed(tree, parsed)


def given_fields(overrides: Iterable[str]) -> list[str]:
    """Return the fields that overrides give values, down into mappings: "a.b" and "a.c" of "a={b: 1, c: 2}"."""
    parser = OverridesParser.create()
    found: list[str] = []
    for text in overrides:
        override = parser.parse_override(text)
        # A deleted field gets no value; several values of a sweep are of the field itself.
        if override.is_delete():
            continue
        if override.is_sweep_override():
            found.append(override.key_or_group)
        else:
            found.extend(leaves(override.key_or_group, _plain(override)))
    return found


def leaves(path: str, value: Plain) -> Iterator[str]:
    """Yield the fields that a value at `path` gives values, down into mappings: "a.b" and "a.c" of {b: 1, c: 2}."""
    if isinstance(value, dict) and value:
        for name, inside in value.items():
            yield from leaves(f"{path}.{name}", inside)
    else:
        yield path


def quoting(text: str) -> str:
    """Return the right spelling of an override whose value has signs of Hydra's grammar; nothing without a value.

    Names of files have them: spaces with brackets, commas, `=`, `~` and letters beyond ASCII.
    """
    # Quoted values and lists are left alone: their signs are meant.
    field, equals, value = text.partition("=")
    if not equals or value[:1] in "'\"[{" or set(value) <= UNQUOTED:
        return ""
    # Inside of double quotes only these need an escape.
    escaped = value.replace('"', '\\"')
    return f"; a name or text with such signs is quoted, for the shell too: '{field}=\"{escaped}\"'"


def check_parsed(tree: Tree, overrides: Iterable[Override]) -> None:
    """Do the same with parsed overrides: each sees fields that the ones before it have added and dropped."""
    # A copy, since later overrides are checked against added and dropped fields.
    tree = copy.deepcopy(dict(tree))
    for override in overrides:
        key = override.key_or_group
        *parents, name = key.split(".")
        makes = override.is_add() or override.is_force_add()
        # "~" and plain overrides need a field that is there.
        if not makes:
            check_key(tree, key)
        if override.is_delete():
            _node(tree, parents).pop(name, None)
        elif not override.is_sweep_override():
            value = _plain(override)
            # "+" makes a field, so that it may be set below; a mapping adds its entries, as Hydra merges.
            if makes or isinstance(value, dict):
                _merge(_node(tree, parents, make=True), {name: value}, parents)
        elif makes:
            _node(tree, parents, make=True)[name] = None
        else:
            for value in _mappings(override):
                _merge(copy.deepcopy(_node(tree, parents)), {name: value}, parents)


def _plain(override: Override) -> Plain:
    # Through OmegaConf, which reads the value as it will later.
    tree: Any = OmegaConf.to_container(OmegaConf.create({"value": override.value()}))
    return tree["value"]


def _mappings(override: Override) -> list[dict[str, Any]]:
    """Return the mappings among the values of a sweep."""
    sweep = override.value()
    if not isinstance(sweep, ChoiceSweep):
        return []
    return [value for value in sweep.list if isinstance(value, dict)]


def _merge(tree: Tree, given: Tree, path: Sequence[str]) -> None:
    """Put values into the mapping at a path of a tree, as Hydra does; refuse empty ones, which change nothing."""
    for name, value in given.items():
        present = tree.get(name)
        if not (isinstance(present, dict) and isinstance(value, dict)):
            tree[name] = value
            continue
        inside = [*path, name]
        if present and not value:
            field = ".".join(inside)
            raise ValueError(
                f"{field}={{}}: a mapping adds its entries to those that are there, and an empty one changes nothing: "
                f"drop each that is too much with ~{field}.NAME: {', '.join(map(str, present))}"
            )
        _merge(present, value, inside)


def _node(tree: Tree, path: Sequence[str], *, make: bool = False) -> Tree:
    """Return the mapping at a path, or an empty one where there is none: made in the tree with `make`."""
    for name in path:
        inside = tree.get(name)
        if not isinstance(inside, dict):
            inside = {}
            if make:
                tree[name] = inside
        tree = inside
    return tree


def check_key(tree: Tree, key: str) -> None:
    """Refuse a dotted key that the tree does not have; the error names the near keys."""
    level: Plain = tree
    parts = key.split(".")
    for depth, part in enumerate(parts):
        if isinstance(level, Mapping) and part in level:
            level = level[part]
        # Entries of lists are named by number.
        elif isinstance(level, list | tuple) and part.isdigit() and int(part) < len(level):
            level = level[int(part)]
        else:
            above = ".".join(parts[:depth])
            names = level if isinstance(level, Mapping) else ()
            choices = [str(name) for name in names if name != TARGET]
            # The class follows from the field so far: it is named by an entry that is added.
            if part == TARGET and above:
                raise ValueError(
                    f"unknown field {key!r}: {above} names no class yet: add it, '+{above}.{TARGET}=...'"
                )
            if above:
                where = f"{above} has no field {part!r}: "
            else:
                where = ""
            # The field exists one level down: most often a group was forgotten.
            inside = [
                top
                for top, below in tree.items()
                if isinstance(below, Mapping) and parts[0] in below
            ]
            if above or not inside:
                hint = near(part, choices)
            else:
                hint = f"did you mean {f'{inside[0]}.{key}'!r}?"
            raise ValueError(f"unknown field {key!r}: {where}{hint}")
