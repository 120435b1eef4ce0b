"""Real runs of the smallest task in processes that are forked warm, so that hundreds of them can be stopped and broken.

The parent builds the task once. A child changes what it likes, for nothing of it comes back, and runs the package's
own code from `run_and_report` on; only the building of env and networks is not done again.
"""

from __future__ import annotations

import dataclasses
import gc
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
import torch.utils.tensorboard  # imported once, before the forks, as Matplotlib is

from ksim_rl import conf
from ksim_rl.cli import errors
from ksim_rl.cli.report import run_and_report
from ksim_rl.runs import curves, record
from ksim_rl.trainers import Checkpoint, Hook, RunCfg, Trainer, run_folder
from ksim_rl.trainers.build import build
from ksim_rl.trainers.loggers import make_loggers

SMALLEST = (
    "task=cartpole_balance",
    "device=cpu",
    "num_envs=2",
    "data.num_env_states_per_minibatch=4",
    "data.num_minibatches=1",
    "modules.actor.hidden_dims=[4]",
    "modules.critic.hidden_dims=[4]",
    "task.episode_length_s=0.1",
    "trainer.num_threads=1",
    "trainer.eval_episodes=2",
    "trainer.eval_interval=2",
    "trainer.checkpoint_interval=1",
    "trainer.num_iterations=3",
    "trainer.video=false",
)
HANGS_S = 120


@cache
def warm(*overrides: str) -> tuple[RunCfg, Trainer]:
    """Build the smallest task and train one iteration, so that every kernel is there."""
    # A fork has none of torch's other threads.
    torch.set_num_threads(1)
    cfg = conf.compose([*SMALLEST, *overrides])
    trainer = build(cfg)
    trainer.iterate()
    if trainer.evaluator is not None:
        trainer.evaluator()
    gc.freeze()  # as the command does; else each child looks through a million objects of the imports
    return cfg, trainer


@dataclass(frozen=True)
class Ended:
    """How a child ended: its exit code (a signal that killed it is negative) and what it printed."""

    code: int
    text: str

    @property
    def raw_traceback(self) -> bool:
        """Whether it printed one."""
        return "Traceback" in self.text or "Exception ignored" in self.text


@dataclass
class Child:
    """A forked process that is still running."""

    pid: int
    output: int
    hangs_s: float = HANGS_S
    text: bytes = b""

    def read(self, until: bytes | None = None) -> bytes:
        """Read what it prints, until it ends or has printed some text; one that says nothing for long is killed."""
        while until is None or until not in self.text:
            ready, _, _ = select.select([self.output], [], [], self.hangs_s)
            if not ready:
                os.kill(self.pid, signal.SIGKILL)
                self.text += b"\nhangs: killed\n"
                break
            more = os.read(self.output, 65536)
            if not more:
                break
            self.text += more
        return self.text

    def wait(self) -> Ended:
        """Wait for its end."""
        self.read()
        os.close(self.output)
        _, status = os.waitpid(self.pid, 0)
        return Ended(os.waitstatus_to_exitcode(status), self.text.decode(errors="replace"))

    def kill(self) -> Ended:
        """Kill it as a crash of the machine would."""
        os.kill(self.pid, signal.SIGKILL)
        return self.wait()


def start(work: Callable[[], int], *, hangs_s: float = HANGS_S) -> Child:
    """Fork, and let the child do `work` and exit with what it returns; its output goes to the parent."""
    warm()
    # Again: who ran in between may have set more, and a fork would wait for them.
    torch.set_num_threads(1)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    reading, writing = os.pipe()
    pid = os.fork()
    if pid:
        os.close(writing)
        return Child(pid, reading, hangs_s)
    code = 99
    try:
        os.close(reading)
        for output in (1, 2):
            os.dup2(writing, output)
        # Whatever a test runner put in their place belongs to the parent.
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        # A shell lets what it starts in the background ignore SIGINT.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = work()
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)


def train(
    folder: Path,
    *,
    hooks: tuple[Hook, ...] = (),
    resume_from: Checkpoint | None = None,
    **trainer_cfg: int,
) -> int:
    """Train in a child as `ksim-rl train` or `resume` does, from the config on; return the exit code."""
    cfg, trainer = warm()
    cfg = dataclasses.replace(cfg, trainer=dataclasses.replace(cfg.trainer, **trainer_cfg))
    trainer.cfg = cfg.trainer

    def build_warm(cfg, *, run_folder, hooks, resume_from):
        again = Trainer(
            cfg.trainer,
            collector=trainer.collector,
            update=trainer.update,
            evaluator=trainer.evaluator,
            solved_at=trainer.solved_at,
            hooks=(*more, *hooks),
            folder=run_folder / "checkpoint",
            config=cfg.to_tree(),
        )
        if resume_from is not None:
            again.load_state_dict(resume_from.state)
        again.loggers = make_loggers(cfg.logger, run_folder, config=again.config)
        return again

    more, run_folder.build = hooks, build_warm
    # Asking git and the machine, and drawing all panels, takes longer than all else that a child does.
    record._code, record.versions, record.hardware = (lambda *_: {}), dict, dict
    curves.PANELS = curves.PANELS[:1]
    try:
        with errors.sigterm_interrupts():
            return run_and_report(cfg, folder, resume_from=resume_from)
    except KeyboardInterrupt as stopped:  # between the two: as `ksim_rl.cli.main` does
        return 128 + int(errors.interruption(stopped))
    except Exception as error:
        return errors.report(error)


def before_first(owner: Any, name: str, act: Callable[[], None]) -> None:
    """Do something before the first call of a function; in a forked process only."""
    inner, done = getattr(owner, name), []

    def first(*arguments: Any, **options: Any) -> Any:
        if not done:
            done.append(True)
            act()
        return inner(*arguments, **options)

    setattr(owner, name, first)


class At(Hook):
    """Does something after one iteration."""

    interval = 1

    def __init__(self, iteration: int, act: Callable[[Trainer], None]) -> None:
        self.iteration, self.act = iteration, act

    def __call__(self, trainer: Trainer) -> None:
        """Act, if it is that iteration."""
        if trainer.iteration == self.iteration:
            self.act(trainer)


def leftovers(folder: Path) -> list[str]:
    """Return what a run that has ended may not leave: locks, half files, and folders with nothing in them."""
    if not folder.exists():
        return []
    entries = [*folder.rglob("*"), folder]
    return [
        str(path)
        for path in entries
        if path.name == ".lock"
        or path.name.startswith((".writing-", ".discarded-"))
        or (path.is_dir() and not any(path.iterdir()))
    ]


def pause(seconds: float) -> None:
    """Wait."""
    time.sleep(seconds)
