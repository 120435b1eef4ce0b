"""Joins a process to the other ranks of its run by torchrun's environment, or refuses it in one line."""

import json
import os
import platform
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist

from ksim_rl.device import group
from ksim_rl.ranks import heartbeat, store
from ksim_rl.ranks.variables import number, world_size

# Variables that torchrun sets; `python -m torch.distributed.run` is the same.
VARIABLES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")
COMMANDS = ("train", "resume")


def launched() -> bool:
    """Whether several processes were started together, as torchrun does."""
    return world_size() > 1


def device(name: str) -> str:
    """Return a device's name as this rank's own: "cuda" is the GPU of its local rank."""
    if group.size() > 1 and name.startswith("cuda"):
        return f"cuda:{number('LOCAL_RANK')}"
    return name


@contextmanager
def joined(command: str) -> Iterator[None]:
    """Join the other ranks for a command, and watch over them; does nothing in a single process.

    Raises ValueError where torchrun's environment is incomplete, ranks would share a GPU, or the command is for one
    process; RuntimeError where the others cannot be reached.
    """
    if not launched():
        yield
        return
    if command not in COMMANDS:
        raise ValueError(
            f"{command} is for one process: start it without torchrun ({' and '.join(COMMANDS)} take it)"
        )
    # WORLD_SIZE alone may be left over in a shell.
    missing = [name for name in VARIABLES if name not in os.environ]
    if missing:
        raise ValueError(
            f"WORLD_SIZE is set and {missing[0]} is not: start the ranks by torchrun, which sets both"
        )
    backend = _backend()
    rank = number("RANK")
    size = world_size()
    if rank >= size:
        raise ValueError(f"RANK={rank}: expected less than WORLD_SIZE={size}, which torchrun sets")
    # The store first: it tells this attempt from earlier ones, whose keys may still be there.
    _runs[:] = [store.of_run(store.connected(serves=store.is_served_by_rank()))]
    try:
        _attempts[:] = [store.attempt(_runs[0], rank=rank, size=size)]
        dist.init_process_group(
            backend,
            store=_of_attempt(_runs[0]),
            rank=rank,
            world_size=size,
            timeout=timedelta(minutes=30),
        )
    except RuntimeError as error:
        raise RuntimeError(
            f"the other ranks cannot be reached: {' '.join(str(error).split())}"
        ) from error
    # Before the first collective on CUDA, which would run on GPU 0 otherwise.
    if backend != "gloo":
        torch.cuda.set_device(number("LOCAL_RANK"))
    # A separate connection, since a connection that waits for a key blocks its other threads.
    heart = heartbeat.Heartbeat(_of_attempt(store.of_run(store.connected())))
    # Other versions may have other collectives, and would wait for each other.
    same = {"ksim_rl": _version(), "torch": torch.__version__, "Python": platform.python_version()}
    try:
        check_same(same, what="version")
        check_gpus(backend)
        # Only in a run that can go on; a refusal above ends this rank, and `ended` tells the others.
        with heart:
            yield
            heart.done()
    except BaseException as error:
        # The others end with this reason, instead of waiting for a rank that is gone.
        heart.ended(error)
        raise
    dist.destroy_process_group()


def check_same(values: Mapping[str, Any], *, what: str) -> None:
    """Refuse, on all ranks, values that differ from rank 0's; the first one is named, by dotted path."""
    if group.size() == 1:
        return
    own = _flat(values)
    parts: list[Any] = [None] * group.size()
    # On the host, since GPUs may not have been checked yet.
    dist.all_gather_object(parts, own, group=_on_host())
    for rank, part in enumerate(parts):
        for name in {**parts[0], **part}:
            ours = parts[0].get(name, "nothing")
            theirs = part.get(name, "nothing")
            if ours != theirs:
                raise ValueError(
                    f"rank {rank} has another {what}: {name} is {theirs} there and {ours} on rank 0; "
                    "start all ranks by the same command, in the same environment"
                )


def by_first(function: Callable[[], str]) -> str:
    """Call a function on rank 0 only, and return its result on all ranks; an OSError is raised on all ranks, too."""
    if group.size() == 1:
        return function()
    texts = ["", ""]
    if group.rank() == 0:
        try:
            texts[0] = function()
        except OSError as error:
            texts[1] = str(error) or type(error).__name__
    # An error must reach all ranks: one that went on would wait for the others.
    dist.broadcast_object_list(texts, src=0, group=_on_host())
    if texts[1]:
        raise OSError(texts[1])
    return texts[0]


def run_folder(own: str) -> str:
    """Return the folder of rank 0, or of the attempt before, if torchrun has started the ranks again.

    This rank's own folder is removed if it is another one, and empty.
    """
    if group.size() == 1:
        return own

    # Rank 0 of the first attempt writes its folder, later attempts read it.
    def kept() -> str:
        if not _runs[0].check(["folder"]):
            _runs[0].set("folder", own)
        return _runs[0].get("folder").decode()

    folder = by_first(kept)
    if folder != own:
        with suppress(OSError):
            os.rmdir(own)
    return folder


def restarted() -> bool:
    """Whether torchrun has started these ranks again, after one of them had failed."""
    return group.size() > 1 and bool(_attempts) and _attempts[0] > 1


_runs: list[dist.PrefixStore] = []
_attempts: list[int] = []
_host_groups: list[Any] = []


def _on_host() -> dist.ProcessGroup | None:
    """Return a group of all ranks whose collectives need no GPU."""
    if dist.get_backend() == "gloo":
        return None
    if not _host_groups:
        _host_groups.append(dist.new_group(backend="gloo"))
    return _host_groups[0]


def _backend() -> str:
    if not torch.cuda.is_available():
        return "gloo"
    local = number("LOCAL_RANK")
    count = torch.cuda.device_count()
    if local >= count:
        raise ValueError(
            f"rank {os.environ['RANK']} has no GPU of its own: this machine has {count}, and torchrun started at least "
            f"{local + 1} ranks here: use --nproc-per-node={count}"
        )
    if not dist.is_nccl_available():
        raise ValueError(
            "this torch has no NCCL, without which GPUs cannot train together: install a CUDA build"
        )
    # Both: tensors of the host travel by gloo, and tensors of GPUs by NCCL.
    return "cpu:gloo,cuda:nccl"


def check_gpus(backend: str) -> None:
    """Refuse two ranks on one GPU, which NCCL answers with an error that names neither."""
    if backend == "gloo":
        return
    # The UUID tells GPUs apart also where CUDA_VISIBLE_DEVICES renumbers them.
    uuid = torch.cuda.get_device_properties(torch.cuda.current_device()).uuid
    places: list[Any] = [None] * group.size()
    dist.all_gather_object(places, f"{socket.gethostname()} {uuid}", group=_on_host())
    for rank, place in enumerate(places):
        if places.index(place) != rank:
            raise ValueError(
                f"ranks {places.index(place)} and {rank} share one GPU ({place}): give each its own"
            )


def _of_attempt(run: dist.Store) -> dist.PrefixStore:
    return dist.PrefixStore(f"attempt/{_attempts[0]}", run)


def _version() -> str:
    from ksim_rl import __version__

    return __version__


def _flat(tree: Mapping[str, Any], path: str = "") -> dict[str, str]:
    found: dict[str, str] = {}
    for name, value in tree.items():
        where = f"{path}{name}"
        found |= (
            _flat(value, f"{where}.")
            if isinstance(value, Mapping)
            else {where: json.dumps(value, default=str)}
        )
    return found
