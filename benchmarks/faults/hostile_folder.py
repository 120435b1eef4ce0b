"""Every command is run in a stranger's folder, in which modules lie that have the names of libraries."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

from benchmarks.faults import children
from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row

MODULES = (
    "mujoco.py",
    "torch.py",
    "sitecustomize.py",
    "usercustomize.py",
    "ksim_rl/__init__.py",
    "numpy.py",
)
# As the installed command starts: its folder is on the path, and not the one in which the user stands.
PROGRAM = (
    "-P",
    "-c",
    "import sys; sys.argv[0] = 'ksim-rl'; from ksim_rl.cli.main import main; main()",
)
TABLE = """\
name: hostile
title: A table of a stranger
groups: {ppo: {objective: ppo, env_states: 1.0e+3, seeds: [1], rows: {One: {task: cartpole_balance}}}}
"""


def write_modules(folder: Path, *, marks: Path) -> None:
    """Write modules that leave a file of their name in `marks` where they are imported."""
    marks.mkdir()
    for name in MODULES:
        mark = marks / name.partition("/")[0].removesuffix(".py")
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"open({str(mark)!r}, 'w').close()\n")


def _commands(output: Path) -> dict[str, list[str]]:
    """Return the arguments of every command, for who stands in a run folder."""
    quick = ["trainer.num_iterations=1", "trainer.eval_episodes=0"]
    model = str(files("ksim_rl.scene.robots").joinpath("quadruped.xml"))
    return {
        "doctor": ["--no-test"],
        "play": [".", "--seconds", "0.1", "--device", "cpu"],
        "resume": [".", "--num-iterations", "3", "--device", "cpu", "trainer.video=true"],
        "train": [
            "--config-dir",
            ".",
            *quick,
            "viewer.browser=true",
            f"hydra.run.dir={output / 'new'}",
        ],
        "eval": [".", "--episodes", "2", "--device", "cpu"],
        "demo": ["--seconds", "0.1", "--output", str(output / "demo.mp4")],
        "zoo": [],
        "runs": ["."],
        "compare": [".", "."],
        "export": [".", "--episodes", "2"],
        "sim2sim": ["export", "--episodes", "2"],
        "diagnose": ["."],
        "warmup": [*children.SMALLEST, *quick],
        "envs": [],
        "robot": [model],
        "new": ["robot", model, "--name", "robot_of_mine", "--output", str(output / "package")],
        "motion": ["csv", "motion.csv", str(output / "motion.npz"), "--robot", "humanoid"],
        "reproduce": [
            str(output.parent / "table.yaml"),
            "--smoke",
            "--device",
            "cpu",
            "--output",
            "tables",
            "--runs",
            "runs",
        ],
    }


def hostile_folder(folder: Path, *, commands: int) -> Figures:
    """Run commands in a run folder that has modules named as libraries; count those that were imported."""
    run, marks = folder / "run", folder / "marks"
    environment = {
        name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")
    }
    words = ["train", *children.SMALLEST, f"hydra.run.dir={run}"]
    subprocess.run([sys.executable, *PROGRAM, *words], env=environment, cwd=folder, timeout=1800)
    write_modules(run, marks=marks)
    (folder / "table.yaml").write_text(TABLE)
    frame = ",".join(["0", "0", "1", "0", "0", "0", "1", *["0"] * 19])
    (run / "motion.csv").write_text(f"{frame}\n{frame}\n")
    found = {"commands": 0, "executed": 0, "tracebacks": 0, "failed": 0}
    for command, arguments in list(_commands(folder / "output").items())[:commands]:
        ended = subprocess.run(
            [sys.executable, *PROGRAM, command, *arguments],
            env=environment,
            cwd=run,
            capture_output=True,
            text=True,
            timeout=1800,
        )
        found["commands"] += 1
        found["executed"] += len(list(marks.iterdir()))
        found["tracebacks"] += "Traceback" in ended.stderr
        found["failed"] += ended.returncode not in (0, 1)
        if ended.returncode not in (0, 1):
            print(f"{command}: exit code {ended.returncode}: {ended.stderr[-600:]}", flush=True)
        shutil.rmtree(marks)
        marks.mkdir()
    return found


ROWS = {
    "hostile_folder": Row(
        fault="every command in a stranger's folder with `mujoco.py`, `torch.py`, `sitecustomize.py` and `ksim_rl`",
        must="none of them is run, by the command or by a process that it starts",
        limits={
            "commands": (AT_LEAST, "commands"),
            **dict.fromkeys(("executed", "tracebacks", "failed"), (EXACTLY, 0)),
        },
        measure=hostile_folder,
        amounts={"commands": 18},
        short={"commands": 2},
        files=("ksim_rl/config/child_processes.py", "ksim_rl/config/plugins.py", "ksim_rl/cli"),
    ),
}
