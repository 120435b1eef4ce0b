"""Shows where an iteration of training spends its time.

    python -m benchmarks.profile task=go1_velocity_flat num_envs=4096 device=cuda

takes the overrides of `ksim-rl train`. On CUDA one iteration runs without graphs, so that each kernel can be laid to
the room in which the host launched it: the substeps of physics, their refresh and resets, the terms (all that is
compiled or left to torch between them: actions, events, commands, rewards, observations, transforms), policy, storage
of the rollout, GAE and update. The times count kernels alone, since the graphs have no pauses for launches;
what the measured iteration (with graphs) takes beyond their sum is the `gaps`, less what runs side by side there. On
the CPU the rooms are timed on the wall clock. Figures go to benchmarks/results/profile.json: `<room>_ms`,
`<room>_share` and, on CUDA, `<room>_kernels`. `label=before` keeps them under another name beside the present ones.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

from rich.console import Console
from rich.table import Table
from torch.profiler import record_function

from benchmarks import command_line, report
from benchmarks.host_traffic import Event, cuda_events
from benchmarks.throughput import iteration_ms
from ksim_rl.device.capture import Captured, live_launches
from ksim_rl.trainers import RunCfg, Trainer, build
from ksim_rl.transforms.innermost import innermost

ROOT = "iteration"
PREFIX = "room:"
LAUNCHES = {"refresh": "refresh", "refresh of rows": "refresh", "reset": "resets"}
"""The rooms of what physics launches, beside its substeps."""


class Clock:
    """Wall-clock times of nested rooms, each without the rooms inside it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inner: list[float] = []

    def run(self, room: str, work: Callable[[], Any]) -> Any:
        """Run `work` in a room."""
        self._inner.append(0.0)
        began = time.perf_counter()
        try:
            with record_function(PREFIX + room):
                return work()
        finally:
            taken = time.perf_counter() - began
            self.seconds[room] += taken - self._inner.pop()
            if self._inner:
                self._inner[-1] += taken


class Live:
    """Stands in for a `Captured`: runs its body at each call, so that the profiler sees each launch, and not one."""

    def __init__(self, captured: Captured) -> None:
        self.body = captured.body
        # A collector that records its env's step anew asks for it.
        self.device = captured.device

    def __call__(self) -> None:
        self.body()


def watch(trainer: Trainer, clock: Clock) -> None:
    """Let what an iteration calls be counted in its room; what no room has is "update"."""
    collector: Any = trainer.collector
    calls: list[tuple[Any, str, Callable[..., str]]] = [
        # Launches of physics go through here in a compiled step, too.
        (
            innermost(collector.env).world._graphs,
            "run",
            lambda key, _: LAUNCHES.get(key, "physics"),
        ),
        (collector.policy, "forward", lambda *_: "policy"),
        (collector, "_store", lambda *_: "storage"),
        (collector, "collect", lambda *_: "terms"),
        (trainer, "_report", lambda *_: "log"),
    ]
    for target, name, room_of in calls:
        method = getattr(target, name)

        def watched(*args: Any, method: Any = method, room_of: Any = room_of, **kwargs: Any) -> Any:
            return clock.run(room_of(*args), lambda: method(*args, **kwargs))

        # Past `nn.Module.__setattr__`, which would register a module.
        object.__setattr__(target, name, watched)


def measure(cfg: RunCfg) -> dict[str, float]:
    """Return the time of each room in one iteration, ms, and on CUDA how many kernels it launches."""
    trainer = build(cfg)
    on_cuda = trainer.update.device.type == "cuda"
    whole = iteration_ms(trainer)
    clock = Clock()
    watch(trainer, clock)
    parts: list[Any] = [trainer.collector, trainer.update]
    for part in parts:
        part._run = Live(part._run)

    def iterate() -> None:
        # What lies outside the rooms inside it is the update.
        with live_launches() if on_cuda else nullcontext():
            clock.run("update", trainer.iterate)

    iterate()
    clock.seconds.clear()
    figures: dict[str, float] = {}
    if on_cuda:
        for room, (count, microseconds) in by_room(cuda_events(iterate)).items():
            figures[f"{room}_ms"] = microseconds / 1000.0
            figures[f"{room}_kernels"] = count
        figures["gaps_ms"] = whole - sum(
            value for name, value in figures.items() if name.endswith("_ms")
        )
    else:
        iterate()
        figures = {f"{room}_ms": 1000.0 * seconds for room, seconds in clock.seconds.items()}
        whole = sum(figures.values())
    shares = {
        name.removesuffix("_ms") + "_share": value / whole
        for name, value in figures.items()
        if name.endswith("_ms")
    }
    return figures | shares | {f"{ROOT}_ms": whole}


def by_room(events: list[Event]) -> dict[str, tuple[int, float]]:
    """Return kernels and their time, us, by the innermost room in which the host launched them."""
    spans = [
        event
        for event in events
        if event.get("name", "").startswith(PREFIX) and event.get("cat") == "user_annotation"
    ]
    spans.sort(key=lambda span: span["dur"])
    launched = {
        event["args"]["correlation"]: event["ts"]
        for event in events
        if event.get("cat") in ("cuda_runtime", "cuda_driver")
        and "correlation" in event.get("args", {})
    }
    found: dict[str, list[float]] = defaultdict(lambda: [0, 0.0])
    for event in events:
        if event.get("cat") not in ("kernel", "gpu_memcpy", "gpu_memset"):
            continue
        at = launched.get(event["args"].get("correlation"), -1.0)
        room = next(
            (s["name"] for s in spans if s["ts"] <= at <= s["ts"] + s["dur"]), PREFIX + "other"
        )
        room = room.removeprefix(PREFIX)
        entry = found["gae" if room == "update" and "advantage" in event["name"].lower() else room]
        entry[0] += 1
        entry[1] += event["dur"]
    return {room: (int(count), microseconds) for room, (count, microseconds) in found.items()}


def main() -> None:
    """Measure, print the table and write the figures."""
    own, overrides = command_line.split(sys.argv[1:], {"label": ""})
    labels = [own["label"]] if own["label"] else []
    fixed = "logger=none", "trainer.eval_episodes=0"
    cfg = command_line.compose([*overrides, *fixed])
    device = cfg.resolved_device()
    figures = measure(cfg)
    table = Table(
        title=f"one iteration of {cfg.task_name}, {cfg.num_envs} envs, {report.device_name(device)}"
    )
    for column in ("room", "ms", "share", "kernels"):
        table.add_column(column, justify="left" if column == "room" else "right")
    rooms = [name.removesuffix("_share") for name in figures if name.endswith("_share")]
    for room in sorted(rooms, key=lambda room: -figures[f"{room}_ms"]):
        kernels = figures.get(f"{room}_kernels")
        table.add_row(
            room,
            f"{figures[f'{room}_ms']:.2f}",
            f"{100 * figures[f'{room}_share']:.1f} %",
            "" if kernels is None else f"{kernels:.0f}",
        )
    Console().print(table)
    prefix = "/".join([report.device_label(device), cfg.task_name, str(cfg.num_envs), *labels])
    path = report.write(
        "profile",
        figures={f"{prefix}/{name}": round(value, 5) for name, value in figures.items()},
        device=device,
        module="benchmarks.profile",
    )
    print(f"written to {path}")


if __name__ == "__main__":
    command_line.run(main)
