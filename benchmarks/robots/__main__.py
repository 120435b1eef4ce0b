"""Tries real files of robots, from packages that are unpacked in one folder, and lists what came of each.

    python -m benchmarks.robots --folder site

`files.yaml` says which of them walk, on which feet, and which line the others get. The packages are those that the
first part of each path is of, such as `pip install --no-deps --target site gymnasium mjlab robosuite`; a file that is
not there is left out of the figures. Exit code 1: a traceback, a line that is not the one of the list, or fewer than
80 % of the walkers stand for 5 s on their feet.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import torch
import yaml

from benchmarks import report
from benchmarks.robots.attempt import Attempt, Listed, attempt

LIST = Path(__file__).with_name("files.yaml")
LEAST_SHARE = 0.8


def read_list() -> list[Listed]:
    """Return the files of the list."""
    return [Listed(**entry) for entry in yaml.safe_load(LIST.read_text())]


def figures_of(tried: dict[str, tuple[Listed, Attempt]]) -> dict[str, float]:
    """Return the figures: counts, and the share of the listed walkers that stand on the listed feet."""
    pairs = list(tried.values())
    walkers = [(listed, found) for listed, found in pairs if listed.feet]
    others = [(listed, found) for listed, found in pairs if not listed.feet]
    standing = sum(found.as_listed for _, found in walkers)
    return {
        "files": len(pairs),
        "walkers": len(walkers),
        "walkers_that_stand": round(standing / max(1, len(walkers)), 4),
        "walkers_trained": sum(found.trained > 0 for _, found in walkers),
        "others_with_their_line": sum(found.as_listed for _, found in others),
        "tracebacks": sum(found.outcome == "traceback" for _, found in pairs),
    }


def earlier() -> dict[str, tuple[Listed, Attempt]]:
    """Return what came of the listed files before, each row with the commit that ran then."""
    path = report.RESULTS / "robots.json"
    rows = json.loads(path.read_text())["robots"] if path.exists() else {}
    return {
        listed.path: (listed, Attempt(**rows[listed.path]))
        for listed in read_list()
        if listed.path in rows
    }


def main() -> int:
    """Try the files, print a line for each, and write benchmarks/results/robots.json."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.robots", description=__doc__)
    parser.add_argument("--folder", type=Path, required=True, help="where the packages are")
    parser.add_argument(
        "--only", default="", help="try files whose path has this in it; other rows stay"
    )
    options = parser.parse_args()
    tried: dict[str, tuple[Listed, Attempt]] = {}
    commit = report.commit()
    for listed in read_list():
        if options.only not in listed.path or not (options.folder / listed.path).is_file():
            continue
        found = attempt(listed, options.folder)
        found.commit = commit
        tried[listed.path] = listed, found
        words = (
            found.said.splitlines()[-1][:160]
            if found.said
            else f"{', '.join(found.feet)} from {found.pose}"
        )
        mark = "as listed" if found.as_listed else "NOT as listed"
        print(f"{listed.path}: {found.outcome} ({mark}, {found.seconds:g} s): {words}", flush=True)
    tried = {**earlier(), **tried}
    figures = figures_of(tried)
    print(figures)
    robots = {path: dataclasses.asdict(found) for path, (_, found) in tried.items()}
    report.write(
        "robots",
        figures=figures,
        device=torch.device("cpu"),
        module="benchmarks.robots",
        robots=robots,
    )
    others_are_told = figures["others_with_their_line"] == figures["files"] - figures["walkers"]
    stand = figures["walkers_that_stand"] >= LEAST_SHARE
    return 0 if stand and others_are_told and not figures["tracebacks"] else 1


if __name__ == "__main__":
    sys.exit(main())
