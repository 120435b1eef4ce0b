"""Gives each of several runs that a launcher starts side by side its own GPU: `ksim-rl train --multirun`."""

import fcntl
import itertools
import os
from pathlib import Path
from typing import IO, Any

import torch
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from ksim_rl.files.writing import open_own

_taken: list[IO[str]] = []  # open, and so locked, until the process ends


class GpuPerJob(Callback):
    """Gives each process that runs jobs of a multirun its own GPU; Hydra calls it before each job."""

    def on_job_start(self, config: DictConfig, **_: Any) -> None:
        """Take a GPU, unless the config names one."""
        if config.hydra.mode == RunMode.MULTIRUN and config.get("device") in ("auto", "cuda"):
            take_gpu(Path(config.hydra.sweep.dir))


def take_gpu(sweep: Path) -> None:
    """Let this process see one GPU only, which no other job of the sweep has, until the process ends.

    A process takes the first slot of the sweep's folder that is free; slot s has GPU s modulo their number, so that
    more jobs than GPUs share them equally. Nothing happens with less than two GPUs, or once CUDA is in use.
    """
    count = torch.cuda.device_count()
    if _taken or count < 2 or torch.cuda.is_initialized():
        return
    # The numbers of a scheduler stay, so that a job takes only GPUs that it was given.
    visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(count)))
    sweep.mkdir(parents=True, exist_ok=True)
    for slot in itertools.count():
        file = open_own(sweep / f".gpu-{slot}")
        try:
            # A lock of the file, which the kernel frees when the process ends, however it ends.
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            continue
        _taken.append(file)
        # It takes effect because CUDA has not been initialized yet; see above.
        os.environ["CUDA_VISIBLE_DEVICES"] = visible.split(",")[slot % count]
        return
