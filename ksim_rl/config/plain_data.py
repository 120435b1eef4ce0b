"""Reads files that a stranger may have written as plain data: nothing in them executes or leads on."""

import re
from collections.abc import Hashable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from ksim_rl.checks import naming
from ksim_rl.config.trees import Plain, Tree
from ksim_rl.config.upstream import yaml_resolvers
from ksim_rl.files.reading import MOST_CONFIG_BYTES, read_bytes

# Deeper trees would exhaust Python's stack.
MOST_DEPTH = 50
MOST_BITS = 64
# In C where PyYAML was built with it: a hundred times as fast.
_FastLoader: Any = yaml.CSafeLoader if yaml.__with_libyaml__ else yaml.SafeLoader


# The name of a field between braces, and nothing else.
_REFERENCE = re.compile(r"\$\{[A-Za-z_.][\w.]*\}", re.ASCII)


class _Loader(_FastLoader):
    """Reads YAML as OmegaConf does, in C: numbers such as 1e-3 are numbers, and dates are text."""

    yaml_implicit_resolvers = yaml_resolvers()

    def construct_mapping(
        self, node: yaml.MappingNode, deep: bool = False
    ) -> dict[Hashable, Plain]:
        """Refuse duplicate keys: one would win in silence."""
        # By their written form, as 1 and "1" are different keys.
        seen: set[str] = set()
        for key, _ in node.value:
            text = repr(self.construct_object(key, deep=True))
            if text in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"duplicate key {text}", problem_mark=key.start_mark
                )
            seen.add(text)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Tree:
    """Return the tree of a YAML file that holds scalars, lists and mappings, and no anchors, tags or interpolations."""
    try:
        text = read_bytes(path, limit=MOST_CONFIG_BYTES).decode()
        # On the events, before any object is made of them.
        check_events(path, text)
        with naming(f"{path}: cannot be read"):  # numbers of more digits than Python reads
            tree: Any = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read: {' '.join(str(error).split())}") from error
    # An empty file is an empty config.
    if tree is None:
        tree = {}
    check_plain(tree, str(path))
    return tree


def check_events(path: Path, text: str) -> None:
    """Refuse a YAML text that names classes by tags, repeats parts by anchors, or is nested without end."""
    depth = 0
    # Anchors may expand to gigabytes, and tags may name classes.
    for event in yaml.parse(text, Loader=_FastLoader):
        found = None
        if isinstance(event, yaml.NodeEvent) and event.anchor is not None:
            found = f"the anchor {event.anchor!r}, and"
        elif (
            isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent)
            and event.tag is not None
        ):
            found = f"the tag {event.tag!r}, and"
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(
            event, yaml.CollectionEndEvent
        )
        if depth > MOST_DEPTH:
            found = f"more than {MOST_DEPTH} levels, and"
        if found is not None:
            line = event.start_mark.line + 1
            raise ValueError(
                f"{path}, line {line}: {found} a config of others holds plain values only"
            )


def check_plain(tree: Any, where: str) -> None:
    """Refuse interpolations, such as `${oc.env:HOME}`, anywhere in a tree: a run's config has values in their place.

    Whole numbers of more than 64 bits are refused too: no message could show one of a million digits.
    """
    if isinstance(tree, Mapping):
        for key, entry in tree.items():
            check_plain(key, where)
            # The path so far; the first part is the file.
            separator = "." if ": " in where else ": "
            check_plain(entry, f"{where}{separator}{key}")
    elif isinstance(tree, (list, tuple)):
        for index, entry in enumerate(tree):
            check_plain(entry, f"{where}[{index}]")
    # Resolvers may read the environment, or run code of a plug-in.
    elif isinstance(tree, str) and "${" in tree:
        raise ValueError(
            f"{where}={tree[:80]!r}: an interpolation, and a run's config holds values only"
        )
    elif isinstance(tree, int) and tree.bit_length() > MOST_BITS:
        raise ValueError(
            f"{where}: a whole number of {tree.bit_length()} bits: expected {MOST_BITS} at most"
        )


def check_references(tree: Plain, where: str) -> None:
    """Refuse interpolations that do more than name another field of the config, such as `${num_envs}`."""
    # The rest, without plain references, must be plain.
    check_plain(_without_references(tree), where)


def _without_references(tree: Any) -> Any:
    if isinstance(tree, Mapping):
        return {_without_references(key): _without_references(entry) for key, entry in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_without_references(entry) for entry in tree]
    # An escaped one stays: Hydra's grammar may turn it into another character.
    if isinstance(tree, str) and "\\" not in tree:
        return _REFERENCE.sub("", tree)
    return tree


def flat(tree: Mapping[str, Plain], path: str = "") -> Iterator[tuple[str, Plain]]:
    """Yield the values of a tree by dotted path; of mappings with entries the entries."""
    for key, value in tree.items():
        # An empty mapping is a value, too.
        if isinstance(value, Mapping) and value:
            yield from flat(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value
