"""Writes the page of `ksim-rl train --help`: groups, and the fields of a config with their meaning."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import yaml

from ksim_rl import algorithms
from ksim_rl.conf.command_line import check_command_line, listed_groups
from ksim_rl.conf.registration import MODULE, NAME, register
from ksim_rl.config.class_paths import TARGET
from ksim_rl.config.field_texts import attribute_texts, first_sentence

WIDTH = 110


def help_page(overrides: Sequence[str]) -> str:
    """Return the page for the config that overrides compose; a ValueError names an override that is wrong."""
    register()
    (cfg, *_) = check_command_line(overrides, name=NAME, multirun=True, values=True)
    # The text that Hydra prints around it for configs of a user's own.
    around = yaml.safe_load(files(MODULE).joinpath("launch.yaml").read_text())["hydra"]["help"]
    return "\n".join(
        (
            around["header"],
            "",
            "== Groups: pick one with group=name (`task` lists the tasks) ==",
            listed_groups(),
            "",
            "== Fields: change one with field.path=value ==",
            *_explained(cfg, cfg.to_tree(), ""),
            "",
            around["footer"].strip(),
        )
    )


def completions() -> list[str]:
    """Return the words that may follow `ksim-rl train`: each choice of each group, and each field with its "="."""
    register()
    words = []
    for line in listed_groups().splitlines():
        group, _, choices = line.partition(": ")
        words += [f"{group}={choice}" for choice in choices.split(", ")]
    (cfg,) = check_command_line((), name=NAME, multirun=False, values=True)
    # Fields of tasks differ from task to task: their own help lists these.
    fields = _paths({name: tree for name, tree in cfg.to_tree().items() if name != "task"}, "")
    for name in algorithms.names():
        fields += [
            f"objective.{field.name}="
            for field in dataclasses.fields(algorithms.algorithm(name).cfg)
        ]
    return [*words, *dict.fromkeys(fields)]


def _paths(tree: Mapping[str, Any], above: str) -> list[str]:
    found = []
    for name, below in tree.items():
        if isinstance(below, Mapping) and below:
            found += _paths(below, f"{above}{name}.")
        elif name != TARGET:
            found.append(f"{above}{name}=")
    return found


def _explained(value: Any, tree: Mapping[str, Any], indent: str) -> list[str]:
    """Return the lines of a tree, in YAML, with the text of each field behind it."""
    if dataclasses.is_dataclass(value):
        texts = attribute_texts(type(value))
    else:
        texts = {}
    lines = []
    for name, below in tree.items():
        inside = _inside(value, name)
        shown = _plain(below)
        line = (
            f"{indent}{name}:"
            if isinstance(below, Mapping) and below
            else f"{indent}{name}: {shown}"
        )
        text = texts.get(name) or (_summary(inside) if isinstance(below, Mapping) else "")
        room = WIDTH - len(line)
        # Beside a long value there is no room for more than a word.
        if text and name != TARGET:
            line += f"  # {first_sentence(text, max(room, 60))}"
        lines.append(line)
        if isinstance(below, Mapping):
            lines += _explained(inside, below, f"{indent}  ")
    return lines


def _inside(value: Any, name: str) -> Any:
    if isinstance(value, Mapping):
        return value.get(name)
    return getattr(value, name, None)


def _summary(value: Any) -> str:
    """Return a dataclass's description, the first line of its docstring."""
    if not dataclasses.is_dataclass(value):
        return ""
    text = (type(value).__doc__ or "").split("\n\n")[0]
    # Python makes a signature the docstring of a dataclass that has none.
    return "" if text.startswith(f"{type(value).__name__}(") else " ".join(text.split())


def _plain(value: Any) -> str:
    """Return a value as it is written on one line of YAML, and on the command line."""
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, Mapping):
        return "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_plain(entry) for entry in value)}]"
    return str(value)
