"""Lists the committed figures that are older than what they measure, and how to renew them.

    python -m benchmarks.figures

Each file of benchmarks/results says which command made it, and at which commit; what a benchmark measures is declared
below, beside its own module. A figure is old once one of these files was changed after that commit.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks import report
from benchmarks.faults.rows import ROWS

ROOT = Path(__file__).parents[1]
STEP = ("ksim_rl/physics", "ksim_rl/envs", "ksim_rl/scene", "ksim_rl/mdp", "ksim_rl/device")
LEARN = (
    "ksim_rl/algorithms",
    "ksim_rl/objectives",
    "ksim_rl/modules",
    "ksim_rl/data",
    "ksim_rl/collectors",
)
TASK = ("ksim_rl/tasks", "ksim_rl/trainers/trainer.py")
# What finds the numbers of joints; networks of motors have no part in it.
IDENTIFY = (
    "ksim_rl/identification/excitation.py",
    "ksim_rl/identification/fit.py",
    "ksim_rl/identification/free_numbers.py",
    "ksim_rl/identification/held_robot.py",
    "ksim_rl/identification/joint_log.py",
    "ksim_rl/identification/simulation.py",
)
# What each benchmark measures; a result takes the longest name that it begins with.
MEASURED: dict[str, tuple[str, ...]] = {
    "agreement": STEP[:1],
    "before_and_now": (*STEP, *LEARN),
    "cameras": (*STEP, *LEARN, "ksim_rl/transforms"),
    "cards": ("ksim_rl/transfer", "ksim_rl/zoo/policies", *STEP),
    "collector": (*STEP, "ksim_rl/collectors"),
    "dm_control": (*STEP, *LEARN, "ksim_rl/suites"),
    "determinism": (*STEP, *LEARN, *TASK),
    "diagnosis": ("ksim_rl/diagnosis", *LEARN),
    "g1_ppo": (*STEP, *LEARN, *TASK),
    "humanoids": (*STEP, *LEARN, *TASK),
    "identification": IDENTIFY,
    "identified_policy": (*IDENTIFY, "ksim_rl/identification/training_overrides.py", *STEP, *LEARN),
    "imitation": (*STEP, *LEARN, "ksim_rl/suites", "ksim_rl/data"),
    "imports": (*LEARN[1:4], "ksim_rl/transforms", "ksim_rl/device", "ksim_rl/physics"),
    "learning": (*STEP, *LEARN, *TASK),
    "manipulation": (*STEP, *LEARN, "ksim_rl/suites"),
    "loop": ("ksim_rl/export/standalone",),
    "motions": (*STEP, *LEARN, "ksim_rl/tracking"),
    "nan_names": ("ksim_rl/envs/non_finite.py", "ksim_rl/device/quick_launch.py"),
    "narrow_phase": ("ksim_rl/physics",),
    "networked_policy": (
        "ksim_rl/identification/actuator_nets.py",
        "ksim_rl/identification/motor_signals.py",
        "ksim_rl/identification/excitation.py",
        *STEP,
        *LEARN,
    ),
    "num_envs": (*STEP, *LEARN),
    "pixels": (*STEP, *LEARN, *TASK),
    "off_policy_update": (*LEARN, "ksim_rl/device"),
    "peer_settings": (*STEP, *LEARN, *TASK),
    "peer_terms": (*STEP, *TASK),
    "peers": (*STEP, *LEARN, *TASK),
    "profile": (*STEP, *LEARN),
    "randomization": STEP,
    "ranks": (*STEP, *LEARN, "ksim_rl/ranks"),
    "resume": (*STEP, *LEARN, "ksim_rl/trainers"),
    # The benchmark and the table of examples/unseen_robots.yaml.
    "robots": ("ksim_rl/scene/robots", "ksim_rl/physics/model_files", *STEP, *LEARN, *TASK),
    "rooms": (*STEP, *LEARN, *TASK),
    "rough": (*STEP, *LEARN, *TASK),
    "scaling": (*STEP, *LEARN),
    "sim2sim": (*STEP, "ksim_rl/export"),
    "tasks": (*STEP, *LEARN, *TASK),
    "terrain": STEP,
    "throughput": (*STEP, *LEARN, *TASK),
    "tracking": (*STEP, *LEARN, "ksim_rl/tracking"),
    "transforms": ("ksim_rl/transforms", "ksim_rl/device"),
    "update": (*LEARN, "ksim_rl/device"),
    "velocity": (*STEP, *LEARN, *TASK),
    "viewer": ("ksim_rl/viewer", *STEP, *LEARN),
}
# Commands of earlier commits that are gone, and what renews their figures now.
RENEWED_BY = {"learning_time": "ksim-rl reproduce velocity --rows ppo/go1"}


@dataclass(frozen=True)
class Old:
    """Figures that something has changed since."""

    figures: str
    commit: str
    command: str
    because: str


def main() -> int:
    """List what is old."""
    found = list(old(report.RESULTS))
    commands = dict.fromkeys(entry.command for entry in found)
    for entry in found:
        print(f"{entry.figures}, measured at {entry.commit[:7]}: {entry.because}")
    if commands:
        print("\nrenew with:")
        for command in commands:
            print(f"    {command}")
    else:
        print("all figures are as new as what they measure")
    return 0


def old(results: Path, root: Path = ROOT) -> Iterator[Old]:
    """Yield the figures of each file that are older than what they measure, with the reason."""
    for path in sorted([*results.glob("*.json"), *results.glob("tables/*.json")]):
        saved = json.loads(path.read_text())
        for group, run in _runs(path.stem, saved).items():
            files = measured(path.stem, group)
            where = f"{path.stem}.json {group}".strip()
            if not files:
                because = "nothing says which files it measures: add it to benchmarks/figures.py"
            else:
                because = _changed_since(run["commit"], (*files, *_own(path.stem, root)), root)
            if because:
                yield Old(
                    where, run["commit"], RENEWED_BY.get(path.stem) or run["command"], because
                )


def measured(name: str, group: str = "") -> tuple[str, ...]:
    """Return the files and folders that a result measures; a fault's row names its own."""
    if name == "faults":
        row = ROWS.get(group.rpartition("/")[2])
        return () if row is None else row.files
    names = [known for known in MEASURED if name == known or name.startswith(f"{known}_")]
    return MEASURED[max(names, key=len)] if names else ()


def _runs(name: str, saved: Mapping) -> dict[str, Mapping]:
    """Return the runs of a file: of the faults one for each row, of others the last one of each command."""
    if name == "faults":
        return dict(saved["runs"])
    last: dict[str, Mapping] = {}
    for group, run in saved.get("runs", {}).items():
        same = [kept for kept, other in last.items() if other["command"] == run["command"]]
        if not same:
            last[group] = run
        elif last[same[0]]["date"] < run["date"]:
            last[same[0]] = run
    return last or {"": saved}


def _own(name: str, root: Path) -> list[str]:
    return [
        str(path.relative_to(root))
        for path in (root / "benchmarks" / f"{name}.py",)
        if path.exists()
    ]


def _changed_since(commit: str, files: tuple[str, ...], root: Path) -> str:
    """Return what has changed since a commit, or why that is unknown; empty where nothing has."""
    known = commit.removesuffix("-dirty")
    here = _git(root, "cat-file", "-e", f"{known}^{{commit}}")
    if here is None:
        return f"its commit {commit!r} is not in this history"
    ancestor = _git(root, "merge-base", "--is-ancestor", known, "HEAD")
    if ancestor is None:
        return f"its commit {known[:7]} is not one that this one came from"
    changed = (_git(root, "diff", "--name-only", known, "--", *files) or "").split()
    if not changed:
        return ""
    more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
    return f"{changed[0]}{more} changed since"


def _git(root: Path, *words: str) -> str | None:
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False)
    return done.stdout if done.returncode == 0 else None


if __name__ == "__main__":
    sys.exit(main())
