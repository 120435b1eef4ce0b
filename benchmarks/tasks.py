"""Checks and times each registered task: `check_env`, sizes, speed beside raw physics, host syncs.

    python -m benchmarks.tasks device=cuda num_envs=4096 [tasks=a,b] [shard=0/4] [check_device=cpu] [results=DIR]

builds each task with the policy network that training gives it, collects rollouts of random actions, and times them
beside the physics of the very same states. `check_env` runs on a few envs, on `check_device` (the same device unless
given; "none" leaves it out). A task that fails is a row of the table like any other; the exit code is 1 then. Figures
go to tasks.json in `results` after each task. Shards split the tasks over processes, one per GPU, each with a folder
of its own;

    python -m benchmarks.tasks merge DIR... [results=DIR]

brings them together, in benchmarks/results unless told otherwise, and prints the whole table.
"""

from __future__ import annotations

import gc
import json
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torchrl.envs import EnvBase

from benchmarks import command_line, report
from benchmarks.raw_physics import physics_ms, record_steps
from benchmarks.stopwatch import milliseconds
from ksim_rl import conf, envs
from ksim_rl.algorithms.ppo.wiring import build_networks
from ksim_rl.checks import check_choice
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.device.streams import checked_device
from ksim_rl.testing import check_env, count_syncs
from ksim_rl.trainers.build import build_env
from ksim_rl.transforms.innermost import innermost

NAME = "tasks"
CHECKED_ENVS = 4
SEED = 1
EAGER_WARMUP = 3
"""Steps that may compile, record graphs and fill caches before syncs are counted."""
KEPT = ["actor", "critic", "action", "action_log_prob", ("next", "reward"), ("next", "done")]
"""What of the rollouts is stored: about what training stores."""
COLUMNS = (
    ("actor", "actor_size", "{:.0f}"),
    ("critic", "critic_size", "{:.0f}"),
    ("action", "action_size", "{:.0f}"),
    ("physics ms", "physics_ms", "{:.3f}"),
    ("env states/s", "env_states_per_s", "{:,.0f}"),
    ("relative to physics", "rollout_over_physics", "{:.3f}"),
    ("syncs", "syncs", "{:.0f}"),
)


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How much is run before and while measuring."""

    rollout_length: int
    warmup_rollouts: int
    timed_rollouts: int
    repeats: int
    """Of each recorded step's physics."""


SCHEDULES = {
    "cuda": Schedule(rollout_length=24, warmup_rollouts=5, timed_rollouts=5, repeats=3),
    "cpu": Schedule(rollout_length=4, warmup_rollouts=1, timed_rollouts=2, repeats=1),
}


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is measured, and where to."""

    names: tuple[str, ...]
    num_envs: int
    device: torch.device
    check_device: torch.device | None
    results: Path


@dataclass(kw_only=True)
class Outcome:
    """What a task's row says beside its figures.

    Attributes:
        check_env: "passed", "failed" or "not run".
        check_device: where `check_env` ran, "" if it did not.
        findings: of `check_env`, and the host syncs that were seen.
        error: of a task that could not be measured, in one line.
    """

    check_env: str = "not run"
    check_device: str = ""
    findings: list[str] = field(default_factory=list)
    error: str = ""

    @property
    def good(self) -> bool:
        """Whether there is nothing to complain about."""
        return not self.findings and not self.error


def options(words: Sequence[str]) -> Options:
    """Read the command line.

    Raises:
        ValueError: naming the option or task that does not exist.
    """
    given = {
        "device": "cuda" if torch.cuda.is_available() else "cpu",
        "num_envs": "4096",
        "tasks": ",".join(name for name in envs.names() if not envs.task(name).suite),
        "shard": "0/1",
        "check_device": "",
        "results": str(report.RESULTS),
    }
    given = command_line.options(words, given)
    names = [envs.task(name).name for name in given["tasks"].split(",")]
    checked = given["check_device"] or given["device"]
    return Options(
        names=shard(names, given["shard"]),
        num_envs=command_line.whole_number("num_envs", given["num_envs"]),
        device=checked_device(given["device"]),
        check_device=None if checked == "none" else checked_device(checked),
        results=Path(given["results"]),
    )


def shard(names: Sequence[str], which: str) -> tuple[str, ...]:
    """Return part "i/n" of the names: neighbours, since they mostly share a robot, and so the kernels to compile."""
    numbers = which.split("/")
    if len(numbers) != 2 or not all(number.isdecimal() for number in numbers):
        raise ValueError(f"shard={which}: expected I/N, such as 0/4")
    index, count = map(int, numbers)
    check_choice("shard", index, range(count))
    part = tuple(names[index * len(names) // count : (index + 1) * len(names) // count])
    if not part:
        raise ValueError(f"shard={which}: there are {len(names)} tasks; use as many shards at most")
    return part


def measure(name: str, options: Options) -> tuple[dict[str, float], Outcome]:
    """Check and time one task; what fails is in the outcome."""
    figures: dict[str, float] = {}
    outcome = Outcome()
    try:
        if options.check_device is not None:
            _check(name, options.check_device, outcome)
        _time(name, options, figures, outcome)
    except Exception as error:  # one task's failure must not keep the others from being measured
        traceback.print_exc()
        outcome.error = f"{type(error).__name__}: {_first_line(error)}"
    return figures, outcome


def _free_memory(device: torch.device) -> None:
    """Give back what the last env held, its graphs included."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def _check(name: str, device: torch.device, outcome: Outcome) -> None:
    env = envs.make(name, num_envs=CHECKED_ENVS, device=device, seed=SEED)
    outcome.check_device = device.type
    try:
        check_env(env)
        outcome.check_env = "passed"
    except AssertionError as error:
        outcome.check_env = "failed"
        outcome.findings += str(error).splitlines()[1:]
    except Exception as error:  # the task can be timed all the same
        outcome.check_env = "failed"
        outcome.findings.append(f"[check_env] {type(error).__name__}: {_first_line(error)}")
        traceback.print_exc()
    finally:
        env.close()


def _time(name: str, options: Options, figures: dict[str, float], outcome: Outcome) -> None:
    _free_memory(options.device)
    device, num_envs, schedule = options.device, options.num_envs, SCHEDULES[options.device.type]
    cfg = conf.compose([f"task={name}", f"device={device}", "logger=none"])
    torch.manual_seed(SEED)
    torch.set_float32_matmul_precision(cfg.trainer.matmul_precision)
    env = build_env(cfg, num_envs=num_envs, seed=SEED)
    try:
        figures |= sizes(env)
        actor, _ = build_networks(cfg, env)
        length = schedule.rollout_length
        collector = RolloutCollector(
            env, actor, rollout_length=length, keys=KEPT, cfg=CollectorCfg(stagger_episodes=True)
        )
        for _ in range(schedule.warmup_rollouts):
            collector.collect()
        rollout_ms = milliseconds(collector.collect, device=device, repeats=schedule.timed_rollouts)
        figures["env_states_per_s"] = 1000.0 * length * num_envs / rollout_ms
        syncs = host_syncs(collector, device)
        figures["syncs"] = len(syncs)
        outcome.findings += [f"[syncs] {sync}" for sync in syncs]
        raw_ms = physics_ms(
            innermost(env).world,
            cfg.task.decimation,
            record_steps(collector),
            repeats=schedule.repeats,
        )
        figures["physics_ms"] = raw_ms
        figures["rollout_over_physics"] = raw_ms * length / rollout_ms
    finally:
        env.close()


def sizes(env: EnvBase) -> dict[str, float]:
    """Return how many numbers networks read and write, bytes of pictures included."""
    spec: Any = env.observation_spec
    # All but the batch dim: a picture has several.
    found = {f"{group}_size": spec[group].shape[1:].numel() for group in ("actor", "critic")}
    return {**found, "action_size": env.action_spec.shape[-1]}


@torch.no_grad()
def host_syncs(collector: RolloutCollector, device: torch.device) -> list[str]:
    """Return the host syncs of one eager step with its masked reset and, on CUDA, of a captured rollout."""
    env: Any = collector.env
    root_E = env.last_root.clone()

    def step() -> None:
        env.step_and_maybe_reset(collector.policy(root_E.copy()))

    for _ in range(EAGER_WARMUP):
        step()
    with count_syncs() as counted:
        step()
    if device.type != "cuda":
        return counted.calls
    # The count misses what C++ reads by itself, and this stops at the first: together they miss none.
    return counted.calls or [
        message
        for work in (step, collector.collect)
        if (message := _sync_error(work, device)) is not None
    ]


def _sync_error(work: Callable[[], object], device: torch.device) -> str | None:
    """Return what torch says about the first host sync of `work`, or None if there is none."""
    torch.cuda.synchronize(device)
    torch.cuda.set_sync_debug_mode("error")
    try:
        work()
    except RuntimeError as error:
        if "synchronizing" not in str(error):
            raise
        return _first_line(error)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return None


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]


def table(saved: Mapping[str, Any]) -> Table:
    """Return the table of all tasks in a report."""
    shown = Table(title="Registered tasks")
    for column in ("task", *(label for label, _, _ in COLUMNS), "check_env"):
        shown.add_column(column, justify="left" if column in ("task", "check_env") else "right")
    for prefix, outcome in sorted(saved["outcomes"].items()):
        figures = {key: saved["figures"].get(f"{prefix}/{key}") for _, key, _ in COLUMNS}
        cells = [
            "" if figures[key] is None else form.format(figures[key]) for _, key, form in COLUMNS
        ]
        shown.add_row(prefix, *cells, outcome["check_env"])
    return shown


def _complaints(saved: Mapping[str, Any]) -> list[str]:
    """Return one line for each finding and error of a report."""
    return [
        f"{prefix}: {line}"
        for prefix, outcome in sorted(saved["outcomes"].items())
        for line in (*outcome["findings"], *filter(None, [outcome["error"]]))
    ]


def main(words: Sequence[str]) -> int:
    """Measure, or merge, print the table, and return the exit code."""
    path = _merge(words[1:]) if words[:1] == ["merge"] else _measure_all(options(words))
    saved = json.loads(path.read_text())
    Console(width=160).print(table(saved))
    complaints = _complaints(saved)
    for line in complaints:
        print(line)
    print(f"written to {path}")
    return 1 if complaints else 0


def _merge(words: Sequence[str]) -> Path:
    results = [word.removeprefix("results=") for word in words if word.startswith("results=")]
    folder = Path(results[-1]) if results else report.RESULTS
    sources = [Path(word) for word in words if not word.startswith("results=")]
    return report.merge(NAME, sources, folder=folder)


def _measure_all(options: Options) -> Path:
    for number, name in enumerate(options.names, start=1):
        began = time.perf_counter()
        figures, outcome = measure(name, options)
        prefix = f"{report.device_label(options.device)}/{name}/{options.num_envs}"
        report.write(
            NAME,
            figures={f"{prefix}/{key}": round(value, 6) for key, value in figures.items()},
            device=options.device,
            module="benchmarks.tasks",
            folder=options.results,
            outcomes={prefix: asdict(outcome)},
        )
        said = "good" if outcome.good else outcome.error or f"{len(outcome.findings)} findings"
        took = time.perf_counter() - began
        print(f"{number}/{len(options.names)} {name}: {said}, {took:.0f} s", flush=True)
    return options.results / f"{NAME}.json"


if __name__ == "__main__":
    command_line.run(lambda: main(sys.argv[1:]))
