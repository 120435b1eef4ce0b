"""Lists the pages that are made of code and results, whole or in part."""

from collections.abc import Callable
from pathlib import Path

from benchmarks import report
from benchmarks.pages import (
    algorithms,
    cameras,
    engines,
    judge,
    learned,
    memory,
    peer_settings,
    peer_terms,
    speed,
    tasks,
    terms,
    terrain_course,
    view,
)
from benchmarks.pages.committed import results

DOCS = Path(__file__).parents[2] / "docs"
WHOLE: dict[str, Callable[[], str]] = {
    "terms.md": terms.page,
    "tasks.md": tasks.page,
    "view.md": view.page,
}
# By page and name: a part stands between two comments, `<!-- made: NAME -->` and `<!-- end: NAME -->`.
PARTS: dict[str, dict[str, Callable[[], str]]] = {
    "coming_from.md": {"peer terms": lambda: peer_terms.table(results("peer_terms"))},
    "learning.md": {
        "algorithms": algorithms.algorithms,
        "walking": learned.walking,
        "suite": learned.suite,
    },
    "memory.md": {
        "per env": memory.per_env,
        "of many": memory.of_many,
        "pictures": memory.pictures,
        "speed": memory.speed,
    },
    "notes/go1.md": {"settings": lambda: peer_settings.text(results("peer_settings"))},
    "notes/rough_ground.md": {"course": lambda: terrain_course.table(results("terrain_course"))},
    "reliability.md": {"judge": lambda: judge.text(results("agreement"))},
    "speed.md": {
        "iteration": speed.iteration,
        "equal runs": speed.equal_runs,
        "larger steps": speed.larger_steps,
        "engines": engines.engines,
    },
    "vision.md": {"cameras": cameras.cameras},
}
NAMES = sorted({*WHOLE, *PARTS})


def made(name: str) -> str:
    """Return the text of a page as code and results have it now."""
    if name in WHOLE:
        return WHOLE[name]()
    text = (DOCS / name).read_text()
    for part, make in PARTS[name].items():
        begin, end = f"<!-- made: {part} -->", f"<!-- end: {part} -->"
        # Without its comments the part would be lost without a word.
        if begin not in text or end not in text:
            raise ValueError(
                f"docs/{name} lacks {begin} or {end}: put both where the table belongs"
            )
        text = report.filled(text, begin, end, make())
    return text
