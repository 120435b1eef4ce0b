"""Reads what docstrings and comments say of the attributes of a class, for help and for pages."""

import dataclasses
import inspect
import re

_HEAD = re.compile(r"^(?:Attributes|Args):$", re.MULTILINE)
_ENTRY = re.compile(r"    ([A-Za-z_]\w*(?:, [A-Za-z_]\w*)*): (.*)")
_COMMENTED = re.compile(r"^    (\w+): .*?  # (.*)$", re.MULTILINE)


def attribute_texts(owner: type) -> dict[str, str]:
    """Return the text of each attribute under "Attributes:" in the docstrings of a class and its bases, by name.

    Of fields of dataclasses it is also the comment at the end of their line. A class's text of an attribute counts more
    than its base's.
    """
    texts: dict[str, str] = {}
    for base in reversed(owner.__mro__):
        texts.update(_comments(base))
        texts.update(_of_docstring(inspect.cleandoc(vars(base).get("__doc__") or "")))
    return texts


def first_sentence(text: str, most: int) -> str:
    """Return the first sentence of a text, cut between two words where it is longer than `most` letters."""
    sentence = re.split(r"(?<=\.)\s", text, maxsplit=1)[0].rstrip(".")
    if len(sentence) <= most:
        return sentence
    return sentence[: most - 3].rpartition(" ")[0] + " ..."


def _comments(owner: type) -> dict[str, str]:
    """Return the comments at the ends of the lines of fields."""
    if not dataclasses.is_dataclass(owner):
        return {}
    try:
        source = inspect.getsource(owner)
    except (OSError, TypeError):
        # A class that was made at run time has no source.
        return {}
    return {match[1]: match[2] for match in _COMMENTED.finditer(source)}


def _of_docstring(text: str) -> dict[str, str]:
    """Return the entries of one docstring: a line `name, name: text` each, with lines that are indented further."""
    found = _HEAD.search(text)
    if found is None:
        return {}
    texts: dict[str, str] = {}
    names: list[str] = []
    for line in text[found.end() :].splitlines():
        entry = _ENTRY.fullmatch(line)
        if entry:
            names = entry[1].split(", ")
            texts.update(dict.fromkeys(names, entry[2].strip()))
        elif line.startswith("     ") and names:
            longer = f"{texts[names[0]]} {line.strip()}"
            texts.update(dict.fromkeys(names, longer))
        elif line.strip():
            # A line that is not indented ends the list.
            break
    return texts
