"""Checks Hydra overrides against a config tree before anything is composed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from ksim_rl.checks import near


def check_overrides(tree: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Refuse overrides of fields that the tree does not have.

    Raises:
        ValueError: naming the override, and the near names at the level where its path leaves the tree.
    """
    for text in overrides:
        try:
            override = OverridesParser.create().parse_override(text)
        except HydraException as error:
            raise ValueError(f"override {text!r} does not parse: {str(error).splitlines()[0]}") from None
        if not override.is_add():
            check_key(tree, override.key_or_group)


def check_key(tree: Mapping[str, Any], key: str) -> None:
    """Refuse a dotted key that the tree does not have; the error names the near keys."""
    level: Any = tree
    parts = key.split(".")
    for depth, part in enumerate(parts):
        if isinstance(level, Mapping) and part in level:
            level = level[part]
        elif (
            isinstance(level, Sequence)
            and not isinstance(level, str)
            and part.isdigit()
            and int(part) < len(level)
        ):
            level = level[int(part)]
        else:
            above = ".".join(parts[:depth])
            choices = (
                [str(name) for name in level if name != "_target_"] if isinstance(level, Mapping) else []
            )
            where = f"{above} has no field {part!r}" if above else f"no field {part!r}"
            raise ValueError(f"unknown field {key!r}: {where}: {near(part, choices)}")
