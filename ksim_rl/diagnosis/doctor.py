"""`ksim-rl doctor` looks at the machine: versions, devices, graphs, OpenGL and caches, with a test on each device.

Its output is meant for a bug report: no names of host and user are in it. A fault is one line, and the exit code 1.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import TimeoutExpired

import torch
import warp as wp

from ksim_rl.checks import OneLineParser
from ksim_rl.config.child_processes import run_python
from ksim_rl.device.compiler_caches import torch_cache, triton_cache
from ksim_rl.device.kernel_loading import compile_notice
from ksim_rl.device.streams import start_warp, warp_device
from ksim_rl.diagnosis.self_test import try_device
from ksim_rl.runs import record
from ksim_rl.scene.rendering import rendering
from ksim_rl.terminal import show

# The driver's own word: it is there also where torch finds no GPU.
NVIDIA = Path("/proc/driver/nvidia/version")
_DRAWS = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 16, 16)
renderer.update_scene(data)
assert renderer.render().any()
"""
# Software drawing may take seconds to start; a broken driver may never answer.
_DRAW_SECONDS = 60


@dataclass
class Report:
    """Lines about the machine, and its faults."""

    lines: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def say(self, subject: str, text: str, *, wrong: bool = False) -> None:
        """Add a line, and a fault where it is one."""
        # Reports are pasted into issues: the user's name is taken out of paths.
        self.lines.append(f"{subject}: {_without_user(text)}")
        if wrong:
            self.faults.append(self.lines[-1])

    def __str__(self) -> str:
        """Return the whole report."""
        faults = [f"FAULT {fault}" for fault in self.faults] or ["no fault found"]
        return "\n".join([*self.lines, *faults])


def examine(*, test_devices: bool = True) -> Report:
    """Look at everything; without `test_devices` nothing is simulated."""
    report = Report()
    report.say(
        "versions", ", ".join(f"{name} {version}" for name, version in record.versions().items())
    )
    hardware = record.hardware()
    # A bug report needs no name of a machine.
    hardware.pop("host", None)
    report.say("machine", ", ".join(f"{name} {value}" for name, value in hardware.items()))
    # Without Warp nothing below can run, but pictures can still be looked at.
    warp_starts = _look_at_caches(report)
    if warp_starts:
        _look_at_gpus(report)
    _look_at_opengl(report)
    if test_devices and warp_starts:
        for device in _devices():
            _try_device(report, device)
    return report


def command(arguments: Sequence[str]) -> int:
    """Run `ksim-rl doctor <arguments>`; the exit code is 1 where there is a fault."""
    parser = OneLineParser(
        prog="ksim-rl doctor",
        description="Check this machine, and print what a bug report needs. The first time, kernels are compiled.",
    )
    parser.add_argument("--no-test", action="store_true", help="look only, and simulate nothing")
    report = examine(test_devices=not parser.parse_args(arguments).no_test)
    show(str(report))
    return 1 if report.faults else 0


def _look_at_caches(report: Report) -> bool:
    """Report the caches, and return whether Warp starts, which makes its own cache as it starts."""
    home = os.environ.get("HOME")
    if not home or not os.access(home, os.W_OK):
        if not home:
            stands = "is not set"
        # Caches go below HOME where nothing else says so.
        else:
            stands = f"is {home}, where nothing can be written"
        report.say(
            "HOME", f"{stands}: set it to a folder of yours, where caches are kept", wrong=True
        )
    wrong = None
    try:
        start_warp()
    except Exception as error:  # Warp raises whatever the file system does
        wrong = f"{type(error).__name__}: {error}"
        report.say("Warp", f"does not start: {wrong}", wrong=True)
    # The caches of the compilers that a training uses, each with the variable that moves it.
    for name, variable, folder in _caches(warp_starts=wrong is None):
        refusal = _refusal(folder)
        if refusal is None:
            size = _bytes_in(folder)
            report.say(f"cache of {name}", f"{folder}, {size / 1e6:,.0f} MB, writable")
        else:
            change = f"make it writable, or set {variable} to a folder that is"
            report.say(f"cache of {name}", f"{folder}: {refusal}; {change}", wrong=True)
    return wrong is None


def _caches(*, warp_starts: bool) -> Iterator[tuple[str, str, Path]]:
    # Warp names its folder only after it has started.
    if warp_starts:
        yield "Warp", "WARP_CACHE_PATH", Path(wp.config.kernel_cache_dir or "")
    caches = [torch_cache()]
    # Triton compiles for GPUs only.
    if torch.cuda.is_available():
        caches.append(triton_cache())
    for cache in caches:
        yield cache.compiler, cache.variable, cache.folder


def _bytes_in(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        with suppress(OSError):  # another process compiles, and moves what it has made
            total += path.stat().st_size if path.is_file() else 0
    return total


def _refusal(folder: Path) -> str | None:
    """Return why nothing can be written into a folder, which is made, or None."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Tried, as permissions alone do not show a full or read-only disk.
        with tempfile.NamedTemporaryFile(dir=folder):
            return None
    except OSError as error:
        return f"not writable ({error.strerror})"


def _devices() -> list[torch.device]:
    return [
        torch.device("cpu"),
        *(torch.device("cuda", index) for index in range(torch.cuda.device_count())),
    ]


def _look_at_gpus(report: Report) -> None:
    gpus = [device for device in _devices() if device.type == "cuda"]
    # A driver without GPUs in torch is a fault; no driver is a machine without GPUs.
    if not gpus:
        if NVIDIA.exists():
            driver = " ".join(NVIDIA.read_text().splitlines()[0].split())
            change = "install a torch that is built for CUDA, or a driver that is new enough for it"
            report.say(
                "GPU",
                f"{driver} is here, and torch {torch.__version__} finds no GPU: {change}",
                wrong=True,
            )
        else:
            report.say("GPU", "none; training runs on the CPU, in one Warp graph per control step")
    for device in gpus:
        about = torch.cuda.get_device_properties(device)
        free, total = torch.cuda.mem_get_info(device)
        driver = wp.get_cuda_driver_version()
        needs = "needs a driver for CUDA 12.4 or newer"
        report.say(
            f"GPU {device.index}",
            f"{about.name}, {free / 2**30:.1f} of {total / 2**30:.1f} GiB free, driver for CUDA {driver}, torch "
            f"for CUDA {torch.version.cuda}",
        )
        # Warp's memory pool is what lets graphs allocate; without it each kernel is launched by itself.
        pool = wp.is_mempool_enabled(warp_device(device))
        if pool:
            text = "available"
        else:
            text = "unavailable, and training about 13 times slower: Warp's memory pool is off"
        report.say(f"graphs on GPU {device.index}", text, wrong=not pool)
        # Loops inside a graph let the solver stop early.
        loops = wp.is_conditional_graph_supported()
        if loops:
            text = "available"
        else:
            text = f"unavailable, and physics slower: the graph's conditional nodes {needs}"
        report.say(f"loops in graphs on GPU {device.index}", text, wrong=not loops)


def _look_at_opengl(report: Report) -> None:
    """Report whether pictures can be drawn off screen, tried in a separate process, since MuJoCo may abort it."""
    # The same choice as for videos.
    try:
        platform = rendering.choose_gl_platform()
    except RuntimeError as error:
        report.say("OpenGL", str(error), wrong=True)
        return
    # In a child: a broken OpenGL aborts the whole process.
    try:
        tried = run_python(
            ["-c", _DRAWS], environment={"MUJOCO_GL": platform}, seconds=_DRAW_SECONDS
        )
        if tried.returncode == 0:
            said = ""
        else:
            # The last line of a traceback has the reason.
            said = (tried.stderr.strip().splitlines() or ["failed"])[-1]
    except TimeoutExpired:
        said = f"no answer in {_DRAW_SECONDS} s"
    if not said:
        report.say("OpenGL", f"{platform} draws")
        return
    change = "unset MUJOCO_GL, or install that platform (Debian: libegl1 libgles2 for egl, libosmesa6 for osmesa)"
    report.say(
        "OpenGL", f"MUJOCO_GL is {platform!r}, and MuJoCo says: {said}; {change}", wrong=True
    )


def _try_device(report: Report, device: torch.device) -> None:
    say: Callable[[str], None] = lambda text: show(f"{text} ...", to_stderr=True)  # noqa: E731
    # The reported time includes compiling.
    began = time.monotonic()
    with compile_notice(say):
        done = try_device(device)
    for name, wrong in done:
        if wrong is not None:
            report.say(f"test on {device}", f"{name}: {wrong}", wrong=True)
    passed = [name for name, wrong in done if wrong is None]
    report.say(
        f"test on {device}",
        f"{', '.join(passed) or 'nothing'} passed in {time.monotonic() - began:.0f} s",
    )


def _without_user(text: str) -> str:
    home = os.path.expanduser("~")
    text = " ".join(text.split())
    if len(home) > 1:
        return text.replace(home, "~")
    return text
