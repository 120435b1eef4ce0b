"""Reads what docstrings say of the attributes of a class, for help and for pages."""

import inspect
import re

_HEAD = "Attributes:"
_ENTRY = re.compile(r"    ([A-Za-z_]\w*(?:, [A-Za-z_]\w*)*): (.*)")


def attribute_texts(owner: type) -> dict[str, str]:
    """Return the text of each attribute under "Attributes:" in the docstrings of a class and its bases, by name.

    A class's text of an attribute counts more than its base's.
    """
    texts: dict[str, str] = {}
    for base in reversed(owner.__mro__):
        texts.update(_of_docstring(inspect.cleandoc(vars(base).get("__doc__") or "")))
    return texts


def _of_docstring(text: str) -> dict[str, str]:
    """Return the entries of one docstring: a line `name, name: text` each, with lines that are indented further."""
    _, _, block = text.partition(_HEAD)
    texts: dict[str, str] = {}
    names: list[str] = []
    for line in block.splitlines():
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
