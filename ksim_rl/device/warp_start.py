"""This module starts Warp once per process."""

import os
import sys
import tempfile
from functools import cache

import torch
import warp as wp

from ksim_rl.device.upstream import ABSENT_DRIVER


@cache
def start_warp() -> None:
    """Start Warp, without its complaint about an absent NVIDIA driver where torch finds no GPU either.

    A run on the CPU is no fault, and who asks for CUDA there is refused by name. The complaint is written by native
    code, so it can be told from other messages only on the file descriptor.
    """
    if torch.cuda.is_available():
        wp.init()
        return
    sys.stderr.flush()
    stderr = os.dup(2)
    try:
        with tempfile.TemporaryFile() as caught:
            os.dup2(caught.fileno(), 2)
            try:
                wp.init()
            finally:
                os.dup2(stderr, 2)
            caught.seek(0)
            lines = caught.read().decode(errors="replace").splitlines(keepends=True)
    finally:
        os.close(stderr)
    sys.stderr.writelines(line for line in lines if ABSENT_DRIVER not in line)
