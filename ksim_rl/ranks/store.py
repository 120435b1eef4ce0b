"""Connects the ranks of a run to a key-value store, in which each attempt to run them has its own keys.

torchrun restarts ranks under the same address and port, with the store as the attempt before has left it: without
separate keys the ranks would find entries of processes that are gone.
"""

import os
import time
from datetime import timedelta
from uuid import uuid4

import torch.distributed as dist

from ksim_rl.ranks.variables import number

# For a rank to start: imports take long where many processes share few cores.
JOIN_S = 300.0


def connected(*, serves: bool = False) -> dist.TCPStore:
    """Return a new connection to the store of all attempts, which rank 0 `serves` where torchrun does not.

    Raises ValueError where the port is in use, RuntimeError where no one answers.
    """
    host = os.environ["MASTER_ADDR"]
    port = number("MASTER_PORT")
    try:
        return dist.TCPStore(
            host, port, is_master=serves, wait_for_workers=False, timeout=timedelta(seconds=JOIN_S)
        )
    except (RuntimeError, OSError) as error:
        reason = " ".join(str(error).split())
        # The user's mistake, which waiting does not mend.
        if "EADDRINUSE" in reason or "address already in use" in reason.lower():
            raise ValueError(
                f"MASTER_PORT={port} is in use on {host}: choose another one"
            ) from error
        raise RuntimeError(
            f"the other ranks cannot be reached at {host}:{port}: {reason}"
        ) from error


def is_served_by_rank() -> bool:
    """Whether this rank has to serve the store: rank 0, where no torchrun does."""
    return os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True" and os.environ["RANK"] == "0"


def of_run(store: dist.Store) -> dist.PrefixStore:
    """Return the part that all attempts of this run see."""
    return dist.PrefixStore(f"ksim_rl/{os.environ.get('TORCHELASTIC_RUN_ID', '')}", store)


def attempt(run: dist.Store, *, rank: int, size: int) -> int:
    """Return which attempt at the run this is, from 1 on, as rank 0 counts them; its store is `run`.

    torchrun's own count is of one node. Each rank asks under a name that no other process has, until rank 0 has
    answered, and says that it has heard: questions of dead processes, and answers to them, do no harm. Raises
    RuntimeError after `JOIN_S` seconds.
    """
    if rank:
        # An answer under this name cannot be one for a process of an earlier attempt.
        name = uuid4().hex
        run.set(f"asks/{rank}", name)
        run.wait([f"answer/{name}"], timedelta(seconds=JOIN_S))
        number = int(run.get(f"answer/{name}"))
        run.set(f"heard/{number}/{rank}", "")
        return number
    # Atomic, and only rank 0 counts.
    number = run.add("attempts", 1)
    waiting = set(range(1, size))
    until = time.monotonic() + JOIN_S
    # Answered again and again: a rank may ask after its dead forerunner has asked.
    while waiting:
        for other in tuple(waiting):
            if run.check([f"asks/{other}"]):
                run.set(f"answer/{run.get(f'asks/{other}').decode()}", str(number))
            if run.check([f"heard/{number}/{other}"]):
                waiting.discard(other)
        if time.monotonic() > until:
            raise RuntimeError(f"rank {min(waiting)} did not start within {JOIN_S:.0f} s")
        # Seconds; short compared with the time in which ranks start.
        time.sleep(0.02)
    return number
