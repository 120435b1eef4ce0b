"""Runs tasks in child processes, so that a crash or a hang ends one of them only."""

import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

# Kernels that were loaded stay in a process; a fresh one frees them.
TASKS_OF_A_PROCESS = 40
# What still runs so many seconds after the end is given up, so that what was found by then is written.
GRACE = 30.0


class _Worker:
    """A process that does tasks one after the other."""

    def __init__(self, do: Callable[[Any], Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self.here, there = context.Pipe()
        self.process = context.Process(target=_serve, args=(do, there), daemon=True)
        self.process.start()
        there.close()
        self.done = 0
        self.is_spoilt = False
        self.task: Any = None
        self.begun = 0.0

    def begin(self, task: Any) -> None:
        self.task, self.begun = task, time.monotonic()
        self.here.send(task)

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.here.close()


def _serve(do: Callable[[Any], Any], there: Connection) -> None:
    while True:
        there.send(do(there.recv()))


def in_processes(
    do: Callable[[Any], Any],
    tasks: Sequence[Any],
    *,
    jobs: int,
    most_seconds: float,
    until: float = float("inf"),
    grace: float = GRACE,
    spoils: Callable[[Any], bool] = lambda result: False,
) -> Iterator[tuple[Any, Any]]:
    """Yield each task with its result; RuntimeError as a result says that its process crashed or took too long.

    Args:
        do: what is done, a function of a module.
        tasks: in which order they begin.
        jobs: how many processes there are.
        most_seconds: that a task may take.
        until: when no further task begins, as time.monotonic says it.
        grace: seconds after that, when tasks that still run are given up.
        spoils: whether a result leaves a process that should do nothing further, as an error on a GPU does.
    """
    left = list(tasks)
    workers: list[_Worker] = []
    try:
        while left or any(worker.task is not None for worker in workers):
            if time.monotonic() > until:
                left.clear()
            if time.monotonic() > until + grace:
                return
            workers = [_fresh(worker, do) if worker.task is None else worker for worker in workers]
            while len(workers) < min(jobs, len(left)):
                workers.append(_Worker(do))
            for worker in workers:
                if worker.task is None and left:
                    worker.begin(left.pop(0))
            busy = [worker for worker in workers if worker.task is not None]
            ready = wait([worker.here for worker in busy], timeout=1.0)
            for worker in busy:
                is_late = time.monotonic() - worker.begun > most_seconds
                if worker.here not in ready and not is_late:
                    continue
                result = _result(worker, is_late=worker.here not in ready)
                worker.is_spoilt = spoils(result)
                yield worker.task, result
                worker.task = None
    finally:
        for worker in workers:
            worker.end()


def _fresh(worker: _Worker, do: Callable[[Any], Any]) -> _Worker:
    if worker.process.is_alive() and not worker.is_spoilt and worker.done < TASKS_OF_A_PROCESS:
        return worker
    worker.end()
    return _Worker(do)


def _result(worker: _Worker, *, is_late: bool) -> Any:
    worker.done += 1
    if is_late:
        worker.process.kill()
        worker.process.join()
        return RuntimeError("it took too long")
    try:
        return worker.here.recv()
    except (EOFError, OSError):
        worker.process.join()
        return RuntimeError(f"its process ended with code {worker.process.exitcode}")
