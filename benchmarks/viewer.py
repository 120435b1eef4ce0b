"""Compares the speed of a run with and without a connected browser.

    python -m benchmarks.viewer task=go1_velocity_flat num_envs=4096 device=cuda

trains with `viewer=browser` and lets a client connect and leave in turn, `blocks` times for `iterations` iterations
each. The client is a process of its own that speaks viser's protocol and reads every message, as a browser does.
Figures go to benchmarks/results/viewer.json: `open_share_of_speed` is the median speed of blocks with a client, divided
by the median of blocks without. The messages and bytes that it read are there too: a client that read none measured
nothing.
"""

from __future__ import annotations

import re
import select
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from ksim_rl import conf
from ksim_rl.device.streams import checked_device
from ksim_rl.trainers import Hook, RunProgress, Trainer, build
from ksim_rl.viewer.live_training import GiveWeights, watched

WARM_UP = 3
"""Blocks that are not timed: kernels compile, graphs are recorded, and the viewer's own env is built."""
PATIENCE_S = 180.0
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (3.0, 3.0, 2.0),
    "fov": 0.9,
    "near": 0.01,
    "far": 100.0,
    "image_height": 800,
    "image_width": 1280,
    "look_at": (0.0, 0.0, 0.5),
    "up_direction": (0.0, 0.0, 1.0),
}
"""What a browser says first; viser counts it as connected from then on."""


def read_all(address: str) -> None:
    """Connect to a viewer as a browser does and read every message until the input ends; print messages and bytes."""
    import msgspec
    import viser
    from websockets.sync.client import connect

    deadline, messages, size = time.monotonic() + PATIENCE_S, 0, 0
    while True:
        try:
            version = f"viser-v{viser.__version__}"
            place = address.replace("http:", "ws:", 1)
            connection = connect(place, subprotocols=[version], max_size=None)  # pyright: ignore
            break
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
    with connection:
        connection.send(msgspec.msgpack.encode(CAMERA))
        while not select.select([sys.stdin], [], [], 0)[0]:
            try:
                size += len(connection.recv(timeout=0.5))
                messages += 1
            except TimeoutError:
                continue
    print(messages, size, flush=True)


class Alternate(Hook):
    """Lets the client connect and leave in turn, and takes the time of the iterations between.

    The viewer's address, which has a token, is the first of `addresses` once it is known.
    """

    def __init__(self, given: GiveWeights, *, interval: int, addresses: Sequence[str]) -> None:
        self.interval, self._given, self._addresses = interval, given, addresses
        self.seconds: dict[bool, list[float]] = {False: [], True: []}
        self.messages, self.bytes = 0, 0
        self._client: subprocess.Popen[str] | None = None
        self._calls, self._start = 0, 0.0

    def __call__(self, trainer: Trainer) -> None:
        """End a block, and begin the next one with the client there or gone."""
        elapsed = time.monotonic() - self._start
        self._calls += 1
        if self._calls > WARM_UP:
            self.seconds[self._client is not None].append(elapsed)
        if self._calls >= WARM_UP:
            if self._client is None:
                self._connect()
            else:
                self.leave()
        self._start = time.monotonic()

    def _connect(self) -> None:
        _wait_for(lambda: bool(self._addresses), "the viewer did not say its address")
        command = [sys.executable, "-m", "benchmarks.viewer", "--client", self._addresses[0]]
        self._client = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._wait(watched=True)

    def leave(self) -> None:
        """Let the client go, and count what it read."""
        if self._client is None:
            return
        said, _ = self._client.communicate()
        messages, size = map(int, said.split())
        self.messages, self.bytes = self.messages + messages, self.bytes + size
        self._client = None
        self._wait(watched=False)

    def _wait(self, *, watched: bool) -> None:
        state = "watched" if watched else "alone"
        _wait_for(lambda: self._given.is_watched == watched, f"the viewer did not become {state}")


def _wait_for(condition: Callable[[], bool], otherwise: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError(otherwise)
        time.sleep(0.05)


def main(arguments: list[str] | None = None) -> None:
    """Measure, print the table, and write the figures."""
    words = sys.argv[1:] if arguments is None else arguments
    if words[:1] == ["--client"]:
        read_all(words[1])
        return
    device = "cuda" if torch.cuda.is_available() else "cpu"
    defaults = {
        "task": "go1_velocity_flat",
        "num_envs": "4096",
        "device": device,
        "iterations": "60",
        "blocks": "4",
        "port": "8400",
    }
    given = command_line.options(words, defaults)
    where = checked_device(given["device"])
    interval, blocks = int(given["iterations"]), int(given["blocks"])
    num_iterations = interval * (WARM_UP + 2 * blocks)
    cfg = conf.compose(
        [
            *(f"{name}={given[name]}" for name in ("task", "num_envs", "device")),
            "viewer=browser",
            f"viewer.port={given['port']}",
            f"trainer.num_iterations={num_iterations}",
            "trainer.eval_episodes=0",
            "trainer.stop_at=null",
            "trainer.video=false",
            "logger=none",
        ]
    )
    console = Console(highlight=False)
    addresses: list[str] = []

    def note(line: str) -> None:
        console.print(line)
        if found := re.match(r"viewer: ([^;]+);", line):
            addresses.append(found[1])

    with watched(cfg, note) as hooks:
        given_away = hooks[0]
        assert isinstance(given_away, GiveWeights)
        alternate = Alternate(given_away, interval=interval, addresses=addresses)
        trainer = build(cfg, hooks=[*hooks, alternate])
        trainer.train(RunProgress(num_iterations, enabled=False))
        alternate.leave()
    per_block = interval * trainer.update.num_env_states
    speeds = {
        name: [per_block / seconds for seconds in alternate.seconds[is_open]]
        for name, is_open in (("closed", False), ("open", True))
    }
    medians = {name: statistics.median(speed) for name, speed in speeds.items()}
    share = medians["open"] / medians["closed"]
    prefix = f"{report.device_label(where)}/{given['task']}"
    figures = {
        f"{prefix}/open_share_of_speed": share,
        f"{prefix}/messages_read": float(alternate.messages),
    }
    figures |= {f"{prefix}/bytes_read": float(alternate.bytes)}
    figures |= {f"{prefix}/{name}_env_states_per_s": median for name, median in medians.items()}
    table = Table("", "env states/s", "blocks")
    for name, speed in speeds.items():
        table.add_row(name, f"{medians[name]:,.0f}", " ".join(f"{value:,.0f}" for value in speed))
    console.print(table)
    console.print(
        f"open / closed: {share:.4f}; {alternate.messages} messages, {alternate.bytes:,} bytes read"
    )
    path = report.write(
        "viewer", figures=figures, device=where, module="benchmarks.viewer", speeds={prefix: speeds}
    )
    console.print(f"written: {path}")


if __name__ == "__main__":
    main()
