"""Trains the first iterations of a run in child processes, to find a number of envs that fits.

A process that ran out of GPU memory cannot try again: torch, for one, never releases the memory of a graph whose
capture failed.
"""

import dataclasses
import json
import sys
from collections.abc import Callable, Iterable

from ksim_rl.config import plugins
from ksim_rl.config.child_processes import go_to_parents_folder, run_python
from ksim_rl.data import ReplayCfg
from ksim_rl.device.memory import free_bytes
from ksim_rl.trainers.build import build
from ksim_rl.trainers.run_cfg import PLUGINS, RunCfg

# One that hangs says where after ten minutes. Nothing is torn down at the end: the driver takes the memory back, and
# behind a capture that broke the libraries' own way out may hang.
PROGRAM = (
    "import faulthandler, os; faulthandler.dump_traceback_later(600, exit=True); "
    "from ksim_rl.trainers import trial; os._exit(trial.main())"
)
# Exit codes.
FITS = 0
DOES_NOT = 3
ITERATIONS = 8  # the first ones run eagerly or fill a replay, the next ones record graphs
SPARE = 0.1  # of the memory that was free


def first_that_fits(
    cfg: RunCfg, numbers: Iterable[int], *, note: Callable[[str], None]
) -> int | None:
    """Return the first of some numbers of envs with which the run trains and leaves a tenth of the memory, or None.

    Numbers that do not divide the data are passed over. `note` reports what is tried, and why it does not fit.
    """
    for num_envs in numbers:
        try:
            # The device by its number: a child process must try the same GPU.
            fewer = dataclasses.replace(cfg, num_envs=num_envs, device=str(cfg.resolved_device()))
        except ValueError:
            continue
        note(f"memory does not suffice: trying num_envs={num_envs}")
        # In a child, so that all its memory is released whatever happens.
        ended = run_python(["-c", PROGRAM], text=json.dumps(fewer.to_tree()))
        if ended.returncode == FITS:
            return num_envs
        # Behind the exit without a teardown, helpers of Python still write to stderr.
        if ended.returncode == DOES_NOT:
            said = ended.stdout
        else:
            said = ended.stderr
        note(
            f"num_envs={num_envs} does not train: {(said.strip() or 'no reason').splitlines()[-1]}"
        )
        if ended.returncode > 0 and ended.returncode != DOES_NOT:
            break  # the config cannot even be built there, and whether memory suffices is unknown
    return None


def main() -> int:
    """Train the config on stdin for a few iterations; return whether memory suffices, as an exit code."""
    go_to_parents_folder()
    tree = json.load(sys.stdin)
    plugins.load(tree.get(PLUGINS, ()))
    cfg = RunCfg.from_tree(tree)
    if isinstance(cfg.data, ReplayCfg):
        # Three rollouts record the graph that only stores, the next three the one that learns.
        soon = min(cfg.data.learning_starts, 3 * cfg.data.num_steps + 1)
        cfg = dataclasses.replace(cfg, data=dataclasses.replace(cfg.data, learning_starts=soon))
    device = cfg.resolved_device()
    # Before anything is built, for the share that must be left.
    free = free_bytes(device)
    try:
        trainer = build(cfg)
        for _ in range(ITERATIONS):
            trainer.iterate()
    # Where memory lacks, libraries have many words for it.
    except (RuntimeError, ValueError) as error:
        print(" ".join(str(error).split()), flush=True)
        return DOES_NOT
    left = free_bytes(device)
    # The first iterations may not show all that a run needs, so some memory must be left.
    if free and left is not None and left < SPARE * free:
        print(f"{left / 1e9:.2f} of {free / 1e9:.2f} GB are left, fewer than a tenth", flush=True)
        return DOES_NOT
    return FITS
