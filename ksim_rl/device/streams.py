"""Starts Warp, and sends its work to a device, in order with torch's current stream.

On CUDA, Warp launches on the very stream that torch uses, so neither waits for the other. The wrappers of streams are
kept for ever: a temporary one that dies unregisters the CUDA stream ("unknown stream"). On CPU, two threads that
launch Warp work at the same time abort the process, so one process-wide lock lets them in one by one.
"""

import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

import torch
import warp as wp

from ksim_rl.device.kernel_cache import mend_damages
from ksim_rl.device.upstream import (
    ABSENT_DRIVER,
    current_stream_handle,
    keep_templates_in_header,
)

CPU_LOCK = threading.RLock()

_warp_streams: dict[tuple[int, int], wp.Stream] = {}


@cache
def start_warp() -> None:
    """Start Warp, without its complaint about an absent NVIDIA driver; a ValueError where it has no folder for kernels.

    A run on the CPU is no fault, and who asks for CUDA there is refused by name. The complaint is written by native
    code, so it can be told from other messages only on the file descriptor.
    """
    # Before Warp starts, as it forgets then which flags modules had so far.
    keep_templates_in_header()
    # Python's own buffer goes out first, so that it is not caught.
    sys.stderr.flush()
    stderr = os.dup(2)
    try:
        # Native code writes to the file descriptor itself, past `sys.stderr`.
        with tempfile.TemporaryFile() as caught:
            os.dup2(caught.fileno(), 2)
            try:
                wp.init()
            except OSError as error:
                raise ValueError(
                    f"Warp's cache: {error}; set WARP_CACHE_PATH to a folder of yours"
                ) from error
            finally:
                os.dup2(stderr, 2)
            caught.seek(0)
            lines = caught.read().decode(errors="replace").splitlines(keepends=True)
    finally:
        os.close(stderr)
    sys.stderr.writelines(line for line in lines if ABSENT_DRIVER not in line)
    mend_damages()


def checked_device(device: str | torch.device) -> torch.device:
    """Return the torch device with its index; a ValueError says what is wrong with it."""
    start_warp()
    try:
        checked = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"device={device!r}: expected 'cpu', 'cuda' or 'cuda:<index>'") from error
    # The CPU has no index: "cpu:0" is the same device.
    if checked.type == "cpu":
        return torch.device("cpu")
    if checked.type != "cuda":
        raise ValueError(f"device={device!r}: expected 'cpu', 'cuda' or 'cuda:<index>'")
    if not torch.cuda.is_available() or not wp.is_cuda_available():
        raise ValueError(
            f"device={device!r}: no CUDA device is available to torch and Warp; use device='cpu', or install an "
            "NVIDIA driver and a CUDA build of torch"
        )
    # "cuda" alone means the current device; later comparisons need its index.
    if checked.index is None:
        index = torch.cuda.current_device()
    else:
        index = checked.index
    if index >= torch.cuda.device_count():
        raise ValueError(
            f"device={device!r}: this machine has {torch.cuda.device_count()} CUDA devices"
        )
    return torch.device("cuda", index)


def warp_device(device: torch.device) -> wp.Device:
    """Return Warp's device for a torch device."""
    return wp.get_device(str(device))


def warp_stream(stream: torch.cuda.Stream) -> wp.Stream:
    """Return the one Warp wrapper of a torch stream, which it holds; both live for ever."""
    key = (stream.device_index, stream.cuda_stream)
    if key not in _warp_streams:
        start_warp()  # without a world there was no need for Warp so far, and its stream look-up does not start it
        _warp_streams[key] = wp.stream_from_torch(stream)
    return _warp_streams[key]


def current_warp_stream(device: torch.device) -> wp.Stream:
    """Return Warp's wrapper of torch's current stream; the look-up by handle spares the making of a stream object."""
    known = _warp_streams.get((device.index, current_stream_handle(device)))
    return known or warp_stream(torch.cuda.current_stream(device))


@contextmanager
def warp_scope(device: torch.device) -> Iterator[None]:
    """Send the Warp work of this block to `device`, ordered with torch's current stream there."""
    if device.type == "cpu":
        start_warp()
        # The lock is reentrant, since such blocks nest.
        with CPU_LOCK, wp.ScopedDevice("cpu"):
            yield
    else:
        stream = warp_stream(torch.cuda.current_stream(device))
        # One stream for both libraries needs no wait in between.
        with wp.ScopedStream(stream, sync_enter=False, sync_exit=False):
            yield


@contextmanager
def waiting_allowed(device: torch.device) -> Iterator[None]:
    """Let the host wait for a device in this block, where torch has been asked to make each wait an error."""
    if device.type != "cuda":
        yield
        return
    # The program's own mode is put back afterwards.
    mode = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("default")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode(mode)


@contextmanager
def beside(side_stream: wp.Stream | None, *launches: Callable[[], None]) -> Iterator[None]:
    """Run `launches` in parallel with the work of this block on a side stream; without a stream, after it.

    Both follow the work before the block and precede the work after it, in a graph too. Neither may write memory that
    the other reads or writes, or free memory that the other allocates: memory is given back in the order of one stream.
    """
    if side_stream is not None:
        # The side stream starts after the work that precedes the block.
        side_stream.wait_stream(side_stream.device.stream)
        with (
            wp.ScopedStream(side_stream, sync_enter=False),
            torch.cuda.stream(wp.stream_to_torch(side_stream)),
        ):
            for launch in launches:
                launch()
        yield
        side_stream.device.stream.wait_stream(side_stream)
    else:
        yield
        for launch in launches:
            launch()
