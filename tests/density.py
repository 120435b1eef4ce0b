"""Measures how dense the package reads: what a statement holds, and means that may only fall."""

import ast
import io
import subprocess
import tokenize
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from tests import signatures

SUBJECT_LETTERS = 72
# Tokens in a line of code and the word `Any` per function, as the package has them. Lower them where it falls;
# a change that makes them rise is too dense, or has no types.
TOKENS_PER_LINE = 8.94
ANY_PER_FUNCTION = 0.09
# The commit since which subjects are held to the limit.
RULED_SINCE = "df0eb0bf"

_NESTING = (ast.ListComp, ast.DictComp, ast.SetComp, ast.GeneratorExp, ast.IfExp, ast.Lambda)
_STATEMENTS = (ast.Assign, ast.AugAssign, ast.Return, ast.Expr)
_NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


def crammed(texts: Mapping[Path, str]) -> Iterator[tuple[Path, int]]:
    """Yield the places of short statements that hold two or more comprehensions, ternaries or lambdas."""
    for path, text in texts.items():
        for node in signatures.nodes(text):
            if not isinstance(node, _STATEMENTS) or _lines(node) > 2:
                continue
            held = [inner for inner in ast.walk(node) if isinstance(inner, _NESTING)]
            if len(held) > 1:
                yield path, node.lineno


def tokens_per_line(texts: Mapping[Path, str]) -> float:
    """Return the mean of tokens in a line of code, docstrings and comments apart."""
    counts = [_tokens_and_lines(text) for text in texts.values()]
    tokens = sum(count for count, _ in counts)
    lines = sum(count for _, count in counts)
    return tokens / max(lines, 1)


def any_per_function(texts: Mapping[Path, str]) -> float:
    """Return how often `Any` is written for each function of the package."""
    words = 0
    functions = 0
    for text in texts.values():
        for node in signatures.nodes(text):
            words += isinstance(node, ast.Name) and node.id == "Any"
            functions += isinstance(node, ast.FunctionDef)
    return words / max(functions, 1)


def long_subjects(checkout: Path, commits: str = f"{RULED_SINCE}..HEAD") -> list[str]:
    """Return subjects of commits that are longer than a log shows in one line; none where there is no history."""
    command = ["git", "-C", str(checkout), "log", "--format=%s", commits]
    done = subprocess.run(command, capture_output=True, text=True)
    return [subject for subject in done.stdout.splitlines() if len(subject) > SUBJECT_LETTERS]


def _lines(node: ast.stmt) -> int:
    assert node.end_lineno is not None
    return node.end_lineno - node.lineno + 1


@cache
def _tokens_and_lines(text: str) -> tuple[int, int]:
    docstrings = signatures.docstring_lines(text)
    tokens = 0
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE and token.start[0] not in docstrings:
            tokens += 1
            lines.update(range(token.start[0], token.end[0] + 1))
    return tokens, len(lines)
