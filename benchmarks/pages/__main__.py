"""Writes the pages of docs/ that are made of code and results, and says which have changed.

python -m benchmarks.pages           # after a change of a term, a task, an algorithm, or a new result
python -m benchmarks.pages --sizes   # builds every task, for the sizes in docs/tasks.md; needs all robots
"""

import argparse

from benchmarks.pages import tasks
from benchmarks.pages.made import DOCS, NAMES, made


def main() -> None:
    """Write the pages."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pages", description=__doc__)
    parser.add_argument("--sizes", action="store_true", help="build every task for its sizes")
    if parser.parse_args().sizes:
        (DOCS / "tasks.md").write_text(tasks.page(tasks.built_sizes()))
    for name in NAMES:
        page = DOCS / name
        text = made(name)
        if text != page.read_text():
            page.write_text(text)
            print(f"wrote docs/{name}")


if __name__ == "__main__":
    main()
