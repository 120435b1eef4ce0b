"""Reads the descriptions of a class's attributes from docstrings and comments, for help and for pages."""

import ast
import dataclasses
import inspect
import io
import re
import textwrap
import tokenize

_HEAD = re.compile(r"^(?:Attributes|Args):$", re.MULTILINE)
_ENTRY = re.compile(r"    ([A-Za-z_]\w*(?:, [A-Za-z_]\w*)*): (.*)")


def attribute_texts(owner: type) -> dict[str, str]:
    """Return the text of each attribute under "Attributes:" in the docstrings of a class and its bases, by name.

    Of fields of dataclasses it is also the comment at the end of their lines. A class's text counts more
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
    """Return the comments at the ends of the lines of each field."""
    if not dataclasses.is_dataclass(owner):
        return {}
    try:
        source = inspect.getsource(owner)
    except (OSError, TypeError):
        # A class that was made at run time has no source.
        return {}
    source = textwrap.dedent(source)
    comments: dict[int, str] = {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        # A comment alone in its line is no text of a field.
        if token.type == tokenize.COMMENT and token.line[: token.start[1]].strip():
            comments[token.start[0]] = token.string.removeprefix("#").strip()
    texts: dict[str, str] = {}
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    for field in tree.body:
        if not isinstance(field, ast.AnnAssign) or not isinstance(field.target, ast.Name):
            continue
        # A field may take several lines, and any of them may have the comment.
        lines = range(field.lineno, (field.end_lineno or field.lineno) + 1)
        said = [comments[line] for line in lines if line in comments]
        if said:
            texts[field.target.id] = " ".join(said)
    return texts


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
