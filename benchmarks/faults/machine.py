"""Machines that lack something: a GPU, CUDA graphs, OpenGL."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import torch

from benchmarks.faults import children
from benchmarks.faults.row import EXACTLY, Figures, Row
from ksim_rl import conf
from ksim_rl.scene.rendering import rendering
from ksim_rl.trainers.build import build


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

        def probe(_command, *, env, works=works, **_options) -> SimpleNamespace:
            failed = env["MUJOCO_GL"] not in works
            return SimpleNamespace(returncode=int(failed), stderr="no such display")

        kept = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "DISPLAY")}
        with (
            mock.patch.dict(os.environ, kept, clear=True),
            mock.patch.object(subprocess, "run", probe),
            mock.patch.object(rendering.importlib, "reload", lambda _module: None),
        ):
            try:
                picked += rendering.choose_gl_platform.__wrapped__() == expected
            except RuntimeError as error:
                message = str(error)
    words = ("EGL", "OSMesa", "Xvfb", "DISPLAY", "no such display")
    return {"platforms": 2, "picked": picked, "error_with_the_fix": all(word in message for word in words)}


ROWS = {
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
