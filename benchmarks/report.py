"""Write what a benchmark measured into benchmarks/results/<name>.json, beside what was measured before."""

import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

# The variable is for benchmarks that run others and take their figures.
RESULTS = Path(os.environ.get("BENCHMARK_RESULTS") or Path(__file__).parent / "results")
WRITTEN = ("benchmarks/results", "docs", "ksim_rl/zoo/transfer")
PACKAGES = (
    "ksim_rl",
    "torch",
    "torchrl",
    "tensordict",
    "mujoco",
    "mujoco-warp",
    "warp-lang",
    "numpy",
)


def device_label(device: torch.device) -> str:
    """Return the word that a device's figures start with: "cpu", or the GPU's short name, such as "h200"."""
    if device.type == "cpu":
        return "cpu"
    words = torch.cuda.get_device_name(device).lower().replace("-", " ").split()
    return next((word for word in words if any(letter.isdigit() for letter in word)), words[-1])


def device_name(device: torch.device) -> str:
    """Return the full name of a device."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that the figures depend on."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    if torch.version.cuda:
        found["cuda"] = torch.version.cuda
    return found


def commit() -> str:
    """Return the commit that ran, with "-dirty" if files differ from it; outside a repository GIT_COMMIT names it.

    Results, pages and cards do not count: a benchmark of several parts writes them between these.
    """

    def git(*words: str) -> str:
        found = subprocess.run(
            ["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
        return found.stdout.strip()

    try:
        changed = git(
            "status", "--porcelain", "--", *(f":(top,exclude){folder}" for folder in WRITTEN)
        )
        return git("rev-parse", "HEAD") + ("-dirty" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return os.environ.get("GIT_COMMIT", "unknown")


def command(module: str) -> str:
    """Return the command line that ran this benchmark."""
    return shlex.join(["python", "-m", module, *sys.argv[1:]])


def write(
    name: str,
    *,
    figures: Mapping[str, float],
    device: torch.device,
    module: str,
    folder: Path = RESULTS,
    **measured: Any,
) -> Path:
    """Merge a run into `<folder>/<name>.json`, replacing the file in one step.

    Args:
        name: of the benchmark.
        figures: flat; each key starts with the device's label. Figures of earlier runs that are not in here stay.
        device: where the run was.
        module: the benchmark's module, for the command line.
        folder: where the results are.
        measured: whatever else was measured; a mapping is merged like the figures, anything else replaces.

    Returns:
        The path of the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    saved = json.loads(path.read_text()) if path.exists() else {}
    run = {
        "command": command(module),
        "commit": commit(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "device": device_name(device),
        "versions": versions(),
    }
    # The file's own entries belong to the last run; `runs` keeps which run each group of figures came from, with
    # the module at its end where that is not the file's own.
    own = module.rpartition(".")[2]
    ending = "" if own == name else f"/{own}"
    runs = {key.rpartition("/")[0] + ending: run for key in figures}
    saved |= run | {
        "figures": {**saved.get("figures", {}), **figures},
        "runs": {**saved.get("runs", {}), **runs},
    }
    for key, value in measured.items():
        saved[key] = {**saved.get(key, {}), **value} if isinstance(value, Mapping) else value
    replace(path, saved)
    return path


def filled(page: str, begin: str, end: str, part: str) -> str:
    """Return a page with this part between two markers of it, in place of what is there."""
    before, _, rest = page.partition(begin)
    return f"{before}{begin}\n\n{part}\n\n{end}{rest.partition(end)[2]}"


def merge(name: str, sources: Sequence[Path], *, folder: Path = RESULTS) -> Path:
    """Merge `<source>/<name>.json` of each source into `<folder>/<name>.json`; of two entries, the later run's stays.

    Returns:
        The path of the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    # The sort keeps this order where dates are equal: what is merged in goes over what was there.
    files = ([path] if path.exists() else []) + [source / f"{name}.json" for source in sources]
    reports = [json.loads(file.read_text()) for file in files]
    merged: dict[str, Any] = {}
    for saved in sorted(reports, key=lambda saved: saved["date"]):
        for key, value in saved.items():
            # What a run was made with is its own; everything else that is a mapping has entries of many runs.
            many = isinstance(value, Mapping) and key != "versions"
            merged[key] = {**merged.get(key, {}), **value} if many else value
    replace(path, merged)
    return path


def replace(path: Path, saved: Mapping[str, Any]) -> None:
    """Write a results file in one step."""
    unfinished = path.with_suffix(".json.part")
    unfinished.write_text(json.dumps(saved, indent=2) + "\n")
    os.replace(unfinished, path)
