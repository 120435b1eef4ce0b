"""Tests of several ranks run here as forked processes of one machine, joined by gloo."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import torch.multiprocessing as mp


def _run_one(
    rank: int, size: int, folder: str, function: Callable[..., Any], arguments: tuple
) -> None:
    gc.freeze()
    torch.set_num_threads(1)
    torch.distributed.init_process_group(
        "gloo", f"file://{folder}/store", rank=rank, world_size=size
    )
    torch.save(function(*arguments), f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


@contextmanager
def as_ranks_compute(dtype: torch.dtype = torch.float32) -> Iterator[None]:
    """Compute on one thread, as each rank does; with float64 for `dtype`, so do problems of pure torch."""
    before = torch.get_num_threads(), torch.get_default_dtype()
    torch.set_num_threads(1)
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        torch.set_default_dtype(before[1])


def results(function: Callable[..., Any], *arguments: Any, size: int, folder: Path) -> list[Any]:
    """Call `function` on each of `size` ranks, and return what it returned there."""
    folder.mkdir(exist_ok=True)
    # A fork has no threads of its parent, and would wait for the threads of MuJoCo's pools that it throws away.
    gc.collect()
    mp.start_processes(
        _run_one, (size, str(folder), function, arguments), nprocs=size, start_method="fork"
    )
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(size)]
