"""This module finds an OpenGL platform that works here: a display, then EGL, then OSMesa."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from functools import cache

_PROBE = "import mujoco; context = mujoco.GLContext(16, 16); context.make_current(); context.free()"
PROBE_SECONDS = 60

FIXES = (
    "no OpenGL platform for off-screen rendering. Fixes: EGL, from a GPU's driver or Mesa (Debian: libegl1 libgles2); "
    "OSMesa, in software (Debian: libosmesa6); or a display, real or virtual (Xvfb :1 & DISPLAY=:1 MUJOCO_GL=glfw)"
)


@cache
def choose_gl_platform() -> str:
    """Make MuJoCo draw with a platform that works, and return its name.

    The environment variable MUJOCO_GL has the last word. Without it each candidate is tried in a process of its own,
    because a platform that fails cannot be exchanged for another in the same process.

    Raises:
        RuntimeError: if none works, with the ways to get one.
    """
    if os.environ.get("MUJOCO_GL"):
        return os.environ["MUJOCO_GL"]
    said = []
    for platform in (["glfw"] if os.environ.get("DISPLAY") else []) + ["egl", "osmesa"]:
        environment = {**os.environ, "MUJOCO_GL": platform}
        command = [sys.executable, "-c", _PROBE]
        try:
            tried = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            said.append(f"{platform}: no answer in {PROBE_SECONDS} s")
            continue
        if tried.returncode == 0:
            os.environ["MUJOCO_GL"] = platform
            # MuJoCo reads the variable when it is imported, which has happened.
            importlib.reload(importlib.import_module("mujoco.rendering.classic.gl_context"))
            return platform
        said.append(f"{platform}: {(tried.stderr.strip().splitlines() or ['failed'])[-1]}")
    raise RuntimeError(f"{FIXES}. Tried {'; '.join(said)}")
