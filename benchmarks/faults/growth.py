"""A soak looks for what grows while nothing should: memory, open files, threads, files on disk, and bytes of logs."""

from __future__ import annotations

import dataclasses
import gc
import json
import os
import re
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import report
from benchmarks.faults import children
from benchmarks.faults.row import AT_LEAST, AT_MOST, EXACTLY, Figures, Row
from ksim_rl.trainers import Hook, RunCfg, RunProgress, Trainer, run_folder

# Torch, Warp and the allocator settle within this share of a run.
SETTLED = 0.4
PICTURE = "faults_soak.png"


def memory(kind: str = "RssAnon") -> int:
    """Return the memory of this process in bytes: its own, or with the pages of libraries ("VmRSS")."""
    (kilobytes,) = re.findall(
        rf"^{kind}:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE
    )
    return int(kilobytes) * 1024


class _Samples(Hook):
    """Looks at the process and at the run folder, a hundred times in a run."""

    interval = 1

    def __init__(self, folder: Path, *, iterations: int) -> None:
        self.folder = folder
        self.samples = folder.parent / "samples.json"
        self.every = max(1, iterations // 100)
        self.rows: list[dict[str, float]] = []

    def __call__(self, trainer: Trainer) -> None:
        at = trainer.iteration
        if at % self.every == 0:
            gc.collect()
            files = [path for path in self.folder.rglob("*") if path.is_file()]
            self.rows.append(
                {
                    "iteration": at,
                    "memory": memory(),
                    "with_libraries": memory("VmRSS"),
                    "python_blocks": sys.getallocatedblocks(),
                    "open_files": len(os.listdir("/proc/self/fd")),
                    "threads": threading.active_count(),
                    "files": len(files),
                    "log_bytes": sum(
                        path.stat().st_size for path in files if "checkpoint" not in str(path)
                    ),
                }
            )
            self.samples.write_text(json.dumps(self.rows))  # also if the process is killed


def _as_it_is(cfg: RunCfg) -> RunCfg:
    return cfg


def soak(
    folder: Path,
    *,
    iterations: int,
    picture: Path | None = None,
    change: Callable[[RunCfg], RunCfg] = _as_it_is,
) -> Figures:
    """Train the smallest task, changed, with all that a run does by default, and look for growth."""
    cfg = change(children.warm()[0])
    sampler = _Samples(folder / "run", iterations=iterations)

    def work() -> int:
        quiet = RunProgress(1, enabled=False)
        trainer_cfg = dataclasses.replace(
            cfg.trainer,
            num_iterations=iterations,
            checkpoint_interval=max(5, iterations // 100),
            eval_interval=max(10, iterations // 20),
            stop_when_solved=False,
        )
        run_folder.run(
            dataclasses.replace(cfg, trainer=trainer_cfg), folder / "run", progress=quiet
        )
        return 0

    build = run_folder.build

    def build_with_samples(*arguments, hooks=(), **options):
        return build(*arguments, hooks=(*hooks, sampler), **options)

    def in_child() -> int:
        run_folder.build = build_with_samples
        return work()

    ended = children.start(in_child, hangs_s=24 * 3600).wait()
    if ended.code:
        raise RuntimeError(f"the soak ended with exit code {ended.code}:\n{ended.text}")
    found = json.loads((folder / "samples.json").read_text())
    if picture is not None:
        draw(found, picture)
    return figures_of(found, iterations=iterations)


def figures_of(rows: list[dict[str, float]], *, iterations: int) -> Figures:
    """Return the growth per iteration once all is settled: the slope of the best line."""
    settled = [row for row in rows if row["iteration"] >= SETTLED * iterations]
    at = np.array([row["iteration"] for row in settled])

    def slope(name: str) -> float:
        return float(np.polyfit(at, [row[name] for row in settled], 1)[0])

    def rise(name: str) -> float:
        return settled[-1][name] - settled[0][name]

    return {
        "iterations": iterations,
        "memory_bytes_per_iteration": round(slope("memory"), 1),
        "memory_mb": round(settled[-1]["memory"] / 1e6, 1),
        "with_libraries_bytes_per_iteration": round(slope("with_libraries"), 1),
        "python_blocks_per_iteration": round(slope("python_blocks"), 2),
        "open_files_rise": rise("open_files"),
        "threads_rise": rise("threads"),
        "files_rise": rise("files"),
        "log_bytes_per_iteration": round(slope("log_bytes"), 1),
    }


def _picture() -> Path:
    report.RESULTS.mkdir(parents=True, exist_ok=True)
    return report.RESULTS / PICTURE


def draw(rows: list[dict[str, float]], picture: Path) -> None:
    """Plot memory, files, threads and logs over the iterations."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = {
        "resident memory (MB)": (("memory", 1e-6), ("with_libraries", 1e-6)),
        "open files and threads": (("open_files", 1), ("threads", 1)),
        "files in the run folder": (("files", 1),),
        "bytes of logs (MB)": (("log_bytes", 1e-6),),
    }
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    for number, (title, series) in enumerate(panels.items()):
        axes = figure.add_subplot(2, 2, number + 1)
        for name, scale in series:
            axes.plot(
                [row["iteration"] for row in rows], [row[name] * scale for row in rows], label=name
            )
        axes.set_title(title, fontsize=10)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.25)
        if len(series) > 1:
            axes.legend(fontsize=8)
    figure.supxlabel("iteration", fontsize=9)
    figure.savefig(picture, dpi=100)


# What no soak may exceed.
LIMITS = {
    "iterations": (AT_LEAST, "iterations"),
    "memory_bytes_per_iteration": (AT_MOST, "most_bytes"),
    # A row of metrics that is kept has dozens.
    "python_blocks_per_iteration": (AT_MOST, "most_blocks"),
    "open_files_rise": (EXACTLY, 0),
    "threads_rise": (EXACTLY, 0),
}
ROWS = {
    "soak": Row(
        fault="10,000 iterations of the smallest task, with logs, evaluations and checkpoints",
        must="memory of the host flat; open files, threads and files bounded; logs grow by a row per iteration",
        limits={
            **LIMITS,
            # The two of the newest checkpoint that a comparison of the compiled step has confirmed, which stays.
            "files_rise": (AT_MOST, 2),
            "log_bytes_per_iteration": (AT_MOST, 5000),
        },
        measure=lambda folder, *, iterations, draws, **_: soak(
            folder, iterations=iterations, picture=_picture() if draws else None
        ),
        # Ten megabytes in a million iterations; in a short run the pages that Python takes count for more.
        amounts={"iterations": 10_000, "draws": 1, "most_bytes": 100, "most_blocks": 3},
        short={"iterations": 100, "draws": 0, "most_bytes": 100_000, "most_blocks": 15},
        files=(
            "ksim_rl/runs/csv_table.py",
            "ksim_rl/config/plain_data.py",
            "ksim_rl/trainers/trainer.py",
            "ksim_rl/trainers/loggers.py",
        ),
    )
}
