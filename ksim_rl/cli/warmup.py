"""`ksim-rl warmup` compiles the kernels of a run ahead of time, and prints how long that took."""

import dataclasses
import time

import warp as wp

from ksim_rl import conf
from ksim_rl.device.kernel_loading import compile_notice
from ksim_rl.terminal import show
from ksim_rl.trainers import RunProgress, build
from ksim_rl.trainers.sources import check_sources

USAGE = """usage: ksim-rl warmup [overrides of ksim-rl train]

Compiles the kernels of a task's physics, terms and networks and keeps them in the caches of Warp, Triton and torch, so
that the next run with the same task starts immediately: one iteration runs, with nothing logged or saved."""


def warmup(arguments: list[str]) -> int:
    """Run one iteration of the config, say how long it took and where the kernels are, and return the exit code."""
    if arguments and arguments[0] in ("-h", "--help"):
        show(USAGE)
        return 0
    # Nothing is logged or evaluated: only compiling is wanted.
    cfg = conf.compose([*arguments, "logger=none", "trainer.eval_episodes=0"])
    check_sources(cfg)
    # Resolved once, so that the message names the device that was used.
    cfg = dataclasses.replace(cfg, device=str(cfg.resolved_device()))
    compiled: list[str] = []
    progress = RunProgress(1)
    began = time.perf_counter()

    def notice(text: str) -> None:
        compiled.append(text)
        progress.status(text)

    # One iteration uses all kernels of a training: physics, terms, networks and the update.
    with compile_notice(notice), progress.busy("compiling"):
        build(cfg).iterate()
    seconds = time.perf_counter() - began
    show(
        f"{cfg.task_name} on {cfg.device}: {seconds:.1f} s; {len(compiled)} kernel modules were compiled, the others "
        f"were cached in {wp.config.kernel_cache_dir}"
    )
    return 0
