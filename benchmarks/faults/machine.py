"""Machines that lack something: a GPU, CUDA graphs, OpenGL."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import torch

from benchmarks.faults import children
from benchmarks.faults.row import EXACTLY, Figures, Row
from ksim_rl import conf
from ksim_rl.scene.rendering import rendering
from ksim_rl.trainers.build import build

# What runs as `ksim-rl` in a process of its own.
PROGRAM = ("-m", "ksim_rl.cli.main")


def no_gpu(folder: Path) -> Figures:
    """Ask for a GPU where there is none."""
    refused = one_line = 0
    with mock.patch.object(torch.cuda, "is_available", lambda: False):
        for device in ("cuda", "cuda:3"):
            try:
                build(conf.compose([*children.SMALLEST, "logger=none", f"device={device}"]))
            except (ValueError, RuntimeError) as error:
                refused += 1
                one_line += device in str(error) and "cpu" in str(error) and "\n" not in str(error)
        auto = conf.compose([*children.SMALLEST, "device=auto"]).resolved_device().type
    return {
        "cases": 2,
        "refused": refused,
        "one_line_with_the_fix": one_line,
        "auto_takes_the_cpu": auto == "cpu",
    }


def headless(folder: Path) -> Figures:
    """Let OpenGL platforms fail, one after the other."""
    picked = 0
    message = ""
    for works, expected in (({"egl", "osmesa"}, "egl"), ({"osmesa"}, "osmesa"), (set(), "")):

        def probe(_words, *, environment, works=works, **_options) -> SimpleNamespace:
            failed = environment["MUJOCO_GL"] not in works
            return SimpleNamespace(returncode=int(failed), stderr="no such display")

        kept = {
            name: value
            for name, value in os.environ.items()
            if name not in ("MUJOCO_GL", "DISPLAY")
        }
        with (
            mock.patch.dict(os.environ, kept, clear=True),
            mock.patch.object(rendering, "run_python", probe),
            mock.patch.object(rendering.importlib, "reload", lambda _module: None),
        ):
            try:
                picked += rendering.choose_gl_platform.__wrapped__() == expected
            except RuntimeError as error:
                message = str(error)
    words = ("EGL", "OSMesa", "Xvfb", "DISPLAY", "no such display")
    return {
        "platforms": 2,
        "picked": picked,
        "error_with_the_fix": all(word in message for word in words),
    }


def caches(folder: Path) -> Figures:
    """Train where nothing can be written at home, where Warp's cache cannot be made, and without a HOME."""
    places = {
        "home": {"HOME": "/dev/null"},
        "warp": {"WARP_CACHE_PATH": "/dev/null/cache"},
        "none": {},
    }
    kept = {
        key: value
        for key, value in os.environ.items()
        if key not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")
    }
    told, codes = 0, {}
    for name, changed in places.items():
        environment = {**kept, **changed}
        if name == "none":
            environment.pop("HOME", None)
        command = [sys.executable, *PROGRAM, "train", *children.SMALLEST]
        command += [
            "trainer.num_iterations=1",
            "trainer.eval_episodes=0",
            f"hydra.run.dir={folder / name}",
        ]
        ended = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=1800
        )
        codes[name] = ended.returncode
        lines = [line for line in ended.stderr.splitlines() if line.startswith("ksim-rl: error")]
        told += (
            len(lines) == 1 and "WARP_CACHE_PATH" in lines[0] and "Traceback" not in ended.stderr
        )
    refused = sum(codes[name] == 2 for name in ("home", "warp"))
    return {
        "refused": refused,
        "one_line_with_the_fix": told,
        "runs_without_home": codes["none"] in (0, 1),
    }


ROWS = {
    "caches": Row(
        fault="HOME or Warp's cache cannot be written; HOME is not set",
        must="refused in one line that names WARP_CACHE_PATH, exit code 2; without HOME it trains",
        limits={
            "refused": (EXACTLY, 2),
            "one_line_with_the_fix": (EXACTLY, 2),
            "runs_without_home": (EXACTLY, 1),
        },
        measure=caches,
        files=("ksim_rl/device/streams.py",),
    ),
    "no_gpu": Row(
        fault="a GPU is asked for where there is none",
        must="refused in one line that names the CPU; `device=auto` takes the CPU",
        limits={
            "cases": (EXACTLY, 2),
            "refused": (EXACTLY, 2),
            "one_line_with_the_fix": (EXACTLY, 2),
            "auto_takes_the_cpu": (EXACTLY, 1),
        },
        measure=no_gpu,
        files=("ksim_rl/trainers/run_cfg.py",),
    ),
    "headless": Row(
        fault="EGL fails, and OSMesa fails too (both injected)",
        must="EGL first, then OSMesa, else an error with the fix",
        limits={"picked": (EXACTLY, 2), "error_with_the_fix": (EXACTLY, 1)},
        measure=headless,
        files=("ksim_rl/scene/rendering/rendering.py",),
    ),
}
