"""Runs the results that a table lacks: a process for each row and seed, in parallel on several GPUs."""

import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from subprocess import STDOUT, Popen
from typing import IO

import torch

from ksim_rl.config.child_processes import start_python
from ksim_rl.files.reading import MOST_DATA_BYTES, read_bytes
from ksim_rl.files.writing import make_folder, open_own
from ksim_rl.runs import run_lock
from ksim_rl.tables.inputs import Sources
from ksim_rl.tables.levels import Result
from ksim_rl.tables.lineage import sources_of
from ksim_rl.tables.measure import RowCfgs
from ksim_rl.tables.table import Table

# Polling is enough: runs take minutes.
POLL_S = 0.2
MOST_RESULT_BYTES = 4 * 2**20
Job = tuple[str, int]  # a row and a seed


class Runs:
    """The runs of one table: results in `folder`/<row>/seed_<n>.json, run folders and logs below `run_folder`."""

    def __init__(self, table: Table, folder: Path, run_folder: Path, *, smoke: bool) -> None:
        self.table = table
        self.folder = folder
        self.run_folder = run_folder
        self.smoke = smoke
        # Composing a config is slow, and each row is asked for many times.
        self._cfgs = RowCfgs(table.rows, smoke=smoke)
        self._runs = Sources(runs=run_folder, fits=self._cfgs.fits, results=folder)

    def results(self) -> dict[str, dict[int, Result]]:
        """Return the results that count, by row and seed: of the settings and files that it has now."""
        found: dict[str, dict[int, Result]] = {}
        for name, row in self.table.rows.items():
            paths = {seed: self.folder / name / f"seed_{seed}.json" for seed in row.seeds}
            present = {seed: _result(path) for seed, path in paths.items() if path.exists()}
            # A result of other settings or files is no result of this row.
            found[name] = {
                seed: result for seed, result in present.items() if self._cfgs.fits(name, result)
            }
        return found

    def complete(self, seeds: Sequence[int]) -> dict[str, list[Result]]:
        """Return the results of rows for which all of `seeds` (none: all of the row) are there."""
        rows = self.table.rows
        found = {}
        for name, results in self.results().items():
            # Without `seeds` each seed of the row has to be there.
            wanted = [seed for seed in rows[name].seeds if not seeds or seed in seeds]
            if wanted and set(wanted) <= results.keys():
                found[name] = [results[seed] for seed in wanted]
        return found

    def run(
        self, jobs: Sequence[Job], *, gpus: Sequence[str], until: float, note: Callable[[str], None]
    ) -> int:
        """Run jobs, one at a time on each of `gpus`, until a moment of `time.monotonic`; count those without result.

        A GPU that is named twice takes two at a time; "" stands for the CPU.
        """
        waiting = list(jobs)
        left = 0
        running: dict[int, tuple[Job, Popen[bytes]]] = {}
        # Jobs that another process had when we looked: their results may appear meanwhile.
        elsewhere: set[Job] = set()
        try:
            while waiting or running:
                is_over = time.monotonic() > until
                # Time is up: nothing starts any more, and running jobs are ended.
                if is_over:
                    left = left + len(waiting)
                    waiting = []
                    for _, process in running.values():
                        process.kill()
                now = [job for job, _ in running.values()]
                for job, why in self._orphans(waiting, now):
                    waiting.remove(job)
                    left += 1
                    note(f"{job[0]}, seed {job[1]}: {why}")
                # One job on each slot; a slot is free as soon as its process has ended.
                for slot, gpu in enumerate(gpus):
                    if slot not in running:
                        now = [job for job, _ in running.values()]
                        taken = self._next(waiting, now, elsewhere, note)
                        if taken is not None:
                            job, log = taken
                            running[slot] = job, self._start(job, gpu, log)
                for slot, (job, process) in list(running.items()):
                    if (code := process.poll()) is not None:
                        del running[slot]
                        # It lost the race for the run folder: try again when the other has ended.
                        if code and not is_over and run_lock.is_locked(self._run(job)):
                            waiting.append(job)  # the other was faster
                            continue
                        # The last line of a Python program that failed is its error.
                        last = "".join(self._said(job).splitlines()[-1:])
                        if is_over:
                            why = "no time left"
                        else:
                            why = f"exit code {code}, {last} ({self._log(job)})"
                        note(f"{job[0]}, seed {job[1]}: " + (why if code else "done"))
                        left += bool(code)
                time.sleep(POLL_S)
        finally:
            # After Ctrl-C: no process is left on a GPU.
            for _, process in running.values():
                process.kill()
                process.wait()
        return left

    def _orphans(self, waiting: Sequence[Job], running: Sequence[Job]) -> list[tuple[Job, str]]:
        """Return jobs that can never begin, each with the reason: a row that it learns from has failed or is not run.

        Half a run leaves a folder and a checkpoint, too: a row learns only from finished runs, whose results count.
        """
        coming = {*waiting, *running}
        ended: list[tuple[Job, Job]] = []
        for job in waiting:
            ended += [(job, source) for source in self._sources(job) if source not in coming]
        if not ended:
            return []
        # Files are read once for all jobs, as this is asked at each poll.
        results = self.results()
        found: dict[Job, str] = {}
        for job, (source, seed) in ended:
            if seed not in results[source]:
                found.setdefault(job, f"row {source!r}, which it learns from, has no result")
                continue
            finished = self._runs.finished(source, seed)
            if isinstance(finished, str):
                found.setdefault(job, f"row {source!r}, which it learns from: {finished}")
        return list(found.items())

    def _sources(self, job: Job) -> list[Job]:
        """Return the jobs that have to be done before this one: rows that it learns from, with its seed."""
        name, seed = job
        return [(source, seed) for source in sources_of(self.table.rows[name])]

    def _next(
        self,
        waiting: list[Job],
        running: Sequence[Job],
        elsewhere: set[Job],
        note: Callable[[str], None],
    ) -> tuple[Job, IO[str]] | None:
        """Take a job that no other process does now, with its log, or None; others' finished jobs are not redone."""
        # A copy, since jobs are taken out of it.
        for job in list(waiting):
            # What it learns from has to be there first.
            if any(source in waiting or source in running for source in self._sources(job)):
                continue
            log = self._claimed(job)
            if log is None:
                elsewhere.add(job)
                continue
            waiting.remove(job)
            # In a smoke test only results of its own time count.
            if (job in elsewhere or not self.smoke) and job[1] in self.results()[job[0]]:
                note(f"{job[0]}, seed {job[1]}: done by another process")
                log.close()
                continue
            return job, log
        return None

    def _claimed(self, job: Job) -> IO[str] | None:
        """Open a job's log and lock it, or return None where another process does the job.

        The job's process inherits the lock with its output, and holds it until it ends, whatever becomes of this one.
        Its run folder is locked later, once it has imported all, so that two processes would begin the same job.
        """
        # A run that was started by hand holds this lock, too.
        if run_lock.is_locked(self._run(job)):
            return None
        path = self._log(job)
        make_folder(path.parent, below=self.run_folder.parent)
        log = open_own(path)
        try:
            # The lock goes to the child with its output.
            if run_lock.try_lock(log):
                return log
        # Without locks there is only one process to expect.
        except OSError as error:
            if error.errno in run_lock.WITHOUT_LOCKS:
                return log
            raise
        log.close()
        return None

    def _start(self, job: Job, gpu: str, log: IO[str]) -> Popen[bytes]:
        name, seed = job
        result = self.folder / name / f"seed_{seed}.json"
        words = [self.table.source, name, seed, result, self._run(job), "cuda" if gpu else "cpu"]
        command = ["-m", "ksim_rl.tables.measure", *map(str, words), "smoke" * self.smoke]
        make_folder(result.parent, below=self.folder.parent)
        # An old result must not be taken for the one of this run.
        result.unlink(missing_ok=True)
        if gpu:
            # The child sees one GPU, as its first.
            environment = {"CUDA_VISIBLE_DEVICES": gpu}
        else:
            environment = {}
        with log:
            # Only now: the log of an earlier attempt is kept until the job is ours.
            log.truncate()
            return start_python(command, environment=environment, stdout=log, stderr=STDOUT)

    def _run(self, job: Job) -> Path:
        return self._log(job).with_suffix("")

    def _said(self, job: Job) -> str:
        return read_bytes(self._log(job), limit=MOST_DATA_BYTES).decode(errors="replace")

    def _log(self, job: Job) -> Path:
        return self.run_folder / job[0] / f"seed_{job[1]}.log"


def _result(path: Path) -> Result:
    return json.loads(read_bytes(path, limit=MOST_RESULT_BYTES))


def gpus_for(device: str, *, per_gpu: int) -> list[str]:
    """Return the GPUs of jobs, as `CUDA_VISIBLE_DEVICES` names them, each `per_gpu` times; [""] on the CPU."""
    every = ",".join(str(index) for index in range(torch.cuda.device_count()))
    # "" is the CPU; there is only one.
    if device == "cpu":
        named = [""]
    else:
        named = (os.environ.get("CUDA_VISIBLE_DEVICES") or every).split(",")
    if named != [""]:
        return named * per_gpu
    return named
