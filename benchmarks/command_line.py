"""The words behind a benchmark's name: options of its own, and overrides of `ksim-rl train`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

from ksim_rl import conf
from ksim_rl.checks import unknown_name
from ksim_rl.trainers import RunCfg


def split(words: Sequence[str], defaults: Mapping[str, str]) -> tuple[dict[str, str], list[str]]:
    """Return the options that `defaults` names, as given or by default, and the other words.

    Raises:
        ValueError: for an option without a value.
    """
    own, others = dict(defaults), []
    for word in words:
        name, _, value = word.partition("=")
        if name not in defaults:
            others.append(word)
        elif value:
            own[name] = value
        else:
            raise ValueError(f"option {word!r} has no value: write {name}=VALUE")
    return own, others


def options(words: Sequence[str], defaults: Mapping[str, str]) -> dict[str, str]:
    """Return the options of a benchmark that takes no overrides.

    Raises:
        ValueError: naming a word that is none of them, and the near ones.
    """
    own, others = split(words, defaults)
    for word in others:
        raise unknown_name("option", word.partition("=")[0], defaults)
    return own


def whole_number(option: str, text: str, *, least: int = 1) -> int:
    """Read a number of at least `least`.

    Raises:
        ValueError: naming the option.
    """
    if not text.isdecimal() or int(text) < least:
        raise ValueError(f"{option}={text}: expected a whole number of at least {least}")
    return int(text)


def whole_numbers(option: str, text: str, *, least: int = 1) -> list[int]:
    """Read such numbers between commas.

    Raises:
        ValueError: naming the option and the number.
    """
    return [whole_number(option, word, least=least) for word in text.split(",")]


def compose(overrides: Sequence[str]) -> RunCfg:
    """Compose a run's config.

    Raises:
        ValueError: in one line, naming the override that is wrong and the near names.
    """
    return conf.compose(overrides)


def run(main: Callable[[], int | None]) -> NoReturn:
    """Run `main` and exit with its code; a wrong value is one line, with its traceback if KSIM_RL_TRACEBACK is set."""
    try:
        sys.exit(main())
    except ValueError as error:
        if os.environ.get("KSIM_RL_TRACEBACK"):
            raise
        sys.exit(f"error: {' '.join(str(error).split())}")
