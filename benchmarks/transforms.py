"""Times each transform beside the nearest one of TorchRL's own, and the usual chain in a control step.

    MENAGERIE_ROOT=... python -m benchmarks.transforms device=cuda num_envs=4096

steps an env that does nothing but hand out 48 numbers, bare and with each transform, and prints one table: milliseconds
of the env step, of the transform's own step and reset (4 of 4096 rows end), and, on CUDA, of its step as a graph. Ours
and TorchRL's are timed in turn, and each ratio is the median over the rounds; on the CPU, process time on one thread is
measured, so that other load on the machine does not count. Where TorchRL has no such transform (noise, delays, the time
that is left), the nearest one is what people build from its parts: `UnaryTransform` with a function that adds noise or
turns a count of steps into the time that is left, and `CatFrames` of as many frames as the delay has to keep. The chain
is noise -> delay -> history of 10 -> groups. Figures go to benchmarks/results/transforms.json.

`go1=true` (the default on CUDA) also times the captured control step of Unitree Go1, bare and with that chain on its
observations: `chain_share_of_go1_step` is what the chain adds (`go1_chain_ms`), relative to the bare step. `only=go1`
times nothing else.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
import time
from collections.abc import Callable

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose

from benchmarks import command_line, report
from benchmarks.stopwatch import milliseconds
from benchmarks.transform_pairs import HISTORY, MAX_LAG, PAIRS, Build
from benchmarks.transforms_env import WideEnv
from ksim_rl import envs
from ksim_rl.checks import check_choice
from ksim_rl.device.capture import Captured
from ksim_rl.device.streams import checked_device
from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from ksim_rl.envs.masked_transformed_env import MaskedTransformedEnv
from ksim_rl.transforms import DelayCfg
from ksim_rl.transforms.groups.group_cfg import compile_groups

CALLS = 10
"""Calls per timing, so that one is long beside the clock's resolution."""
MIN_ROUNDS = 15
MAX_ROUNDS = 400
SECONDS = 1.0
"""Rounds of a comparison: as many as fit into these seconds, within these limits."""
GO1_STEPS = {"cuda": 200, "cpu": 2}

Row = dict[str, float | None]


def measure(num_envs: int, device: torch.device) -> dict[str, Row]:
    """Time each transform and its nearest; return ms and ratios by row and column."""
    bare = WideEnv(num_envs, device=device)
    root = bare.rand_action(bare.reset())
    found = [_time(lambda: bare.step(root.copy()), device) for _ in range(MIN_ROUNDS)]
    rows: dict[str, Row] = {"bare env": {"env_ms": statistics.median(found)}}
    for name, pair in PAIRS.items():
        mine, theirs = (_Rig(build, num_envs, device) for build in (pair.ours, pair.stock))
        rows[name] = {}
        for what in ("env", "step", "reset"):
            rows[name] |= _compare(what, getattr(mine, what), getattr(theirs, what), device)
    if device.type == "cuda":
        graphs = {
            name: _Rig(pair.ours, num_envs, device).captured() for name, pair in PAIRS.items()
        }
        # Stock ones last: what cannot be captured leaves torch's generator in a bad state.
        for name, pair in PAIRS.items():
            mine, theirs = graphs[name], _Rig(pair.stock, num_envs, device).captured()
            if mine is not None:
                rows[name] |= _compare("captured", mine, theirs, device, calls=1, per=CALLS)
    return rows


class _Rig:
    """A transform in an env, ready to be timed."""

    def __init__(self, build: Build, num_envs: int, device: torch.device) -> None:
        self.device = device
        self.transformed = TransformedEnv(WideEnv(num_envs, device=device), build())
        self.root = self.transformed.rand_action(self.transformed.reset())
        for _ in range(3):
            self.transformed.step(self.root.copy())
        self.transform = self.transformed.transform
        self.reached = self.transformed.base_env.step(self.root.copy())["next"]
        mask = torch.zeros(num_envs, 1, dtype=torch.bool, device=device)
        mask[:: max(1, num_envs // 4)] = True
        self.reset_td = TensorDict({"_reset": mask}, batch_size=[num_envs], device=device)

    @torch.no_grad()
    def env(self) -> None:
        """Step the env with the transform."""
        self.transformed.step(self.root.copy())

    @torch.no_grad()
    def step(self) -> None:
        """Do what the transform does in a step: with the action, and with what the env answers."""
        sent = (
            self.transform._inv_call(self.root.copy()) if self.transform.in_keys_inv else self.root
        )
        self.transform._step(sent, self.reached.copy())

    @torch.no_grad()
    def reset(self) -> None:
        """Do what the transform does in a reset of some rows."""
        self.transform._reset(self.reset_td, self.reached.copy())

    def captured(self) -> Callable[[], object] | None:
        """Return the steps as a graph, or None where they cannot be captured."""

        def steps() -> None:
            for _ in range(CALLS):
                self.step()

        graph = Captured(steps, device=self.device, warmup=2)
        try:
            for _ in range(4):
                graph()
        except RuntimeError:
            _renew_generator(self.device)
            return None
        return graph


def _renew_generator(device: torch.device) -> None:
    """Give torch's generator a new state: after a capture that failed it believes to be in one still."""
    fresh = torch.Generator(device)
    torch.cuda.default_generators[torch.cuda.current_device()].graphsafe_set_state(
        fresh.graphsafe_get_state()
    )


def _time(
    work: Callable[[], object], device: torch.device, *, calls: int = CALLS, per: int = 1
) -> float:
    """Return the ms of one of `calls` calls, each of which runs the transform `per` times."""

    def repeatedly() -> None:
        for _ in range(calls):
            work()

    if device.type == "cuda":
        return milliseconds(repeatedly, device=device, repeats=1) / (calls * per)
    began = time.process_time()
    repeatedly()
    return 1000.0 * (time.process_time() - began) / (calls * per)


def _compare(
    what: str,
    mine: Callable[[], object],
    theirs: Callable[[], object] | None,
    device: torch.device,
    **kwargs: int,
) -> Row:
    """Time the two in turn, each of them first in every other round; return the medians, and the median ratio."""
    for work in (mine, theirs):
        if work is not None:
            _time(work, device, **kwargs)
    times: list[list[float]] = [[], []]
    began = time.perf_counter()
    while len(times[0]) < MIN_ROUNDS or (
        len(times[0]) < MAX_ROUNDS and time.perf_counter() - began < SECONDS
    ):
        order = ((mine, 0), (theirs, 1)) if len(times[0]) % 2 else ((theirs, 1), (mine, 0))
        for work, index in order:
            if work is not None:
                times[index].append(_time(work, device, **kwargs))
    row: Row = {
        f"{what}_ms": statistics.median(times[0]),
        f"stock_{what}_ms": None,
        f"{what}_ratio": None,
    }
    if theirs is not None:
        row[f"stock_{what}_ms"] = statistics.median(times[1])
        row[f"{what}_ratio"] = statistics.median(a / b for a, b in zip(*times, strict=True))
    return row


def measure_go1(num_envs: int, device: torch.device) -> dict[str, float]:
    """Time the control step of Go1 that stands and stumbles, bare and with the chain on its observations, in turn.

    The bare env hands out its readings as they are: without noise and without groups. Both envs have one seed and get
    the same actions, so they step through the same states, and what the chain adds is the median of the differences.
    """
    cfg = envs.make_cfg("go1_velocity_flat", [f"task.scene.num_envs={num_envs}", "task.seed=0"])
    groups = {
        name: dataclasses.replace(group, delay=DelayCfg(max_lag=MAX_LAG), history=HISTORY)
        for name, group in cfg.observations.items()
        if name == "actor"
    }
    chain = compile_groups(groups)
    bare, chained = (
        _Go1(cfg, transforms, device) for transforms in (Compose([]), Compose(list(chain)))
    )
    generator = torch.Generator(device).manual_seed(0)
    times: tuple[list[float], list[float]] = ([], [])
    settle = GO1_STEPS[device.type] // 2
    for step in range(-settle, GO1_STEPS[device.type]):
        action_EL = 0.3 * torch.randn(bare.action_EL.shape, generator=generator, device=device)
        order = (bare, chained) if step % 2 else (chained, bare)
        for rig in order:
            rig.action_EL.copy_(action_EL)
            found = milliseconds(rig.step, device=device, repeats=1)
            if step >= 0:
                times[rig is chained].append(found)
    step_ms = statistics.median(times[0])
    chain_ms = statistics.median(both - alone for alone, both in zip(*times, strict=True))
    return {
        "go1_step_ms": step_ms,
        "go1_step_with_chain_ms": statistics.median(times[1]),
        "go1_chain_ms": chain_ms,
        "go1_contacts_per_env": bare.contacts_per_env(),
        "chain_share_of_go1_step": chain_ms / step_ms,
    }


class _Go1:
    """Go1 with transforms, whose step is one graph."""

    def __init__(
        self, cfg: ManagerBasedRlEnvCfg, transforms: Compose, device: torch.device
    ) -> None:
        self.base = ManagerBasedRlEnv(cfg, device=device)
        self.env = MaskedTransformedEnv(self.base, transforms)
        self.env.seed(0)
        with torch.no_grad():
            self.root_E = self.env.rand_action(self.env.reset())
        self.action_EL = torch.zeros_like(self.root_E["action"])
        self.step = Captured(self._step, device=device, warmup=2)
        for _ in range(4):
            self.step()

    @torch.no_grad()
    def _step(self) -> None:
        self.env.step_and_maybe_reset(self.root_E.copy().set("action", self.action_EL))

    def contacts_per_env(self) -> float:
        """Return the mean number of contacts now."""
        return float(self.base.world.last_substep("nacon").item()) / self.base.num_envs


def _table(rows: dict[str, Row], num_envs: int, device: torch.device) -> Table:
    table = Table(
        title=f"{num_envs} envs, {report.device_name(device)}; ms of ours / of the nearest: ratio"
    )
    columns = ["env", "step", "reset", *(["captured"] if device.type == "cuda" else [])]
    for heading in ("transform", "nearest", *columns):
        table.add_column(
            heading, justify="left" if heading in ("transform", "nearest") else "right"
        )
    for name, row in rows.items():
        nearest = PAIRS[name].nearest if name in PAIRS else ""
        table.add_row(name, nearest, *(_cell(row, column) for column in columns))
    return table


def _cell(row: Row, column: str) -> str:
    if f"{column}_ms" not in row:
        return ""
    mine, theirs, ratio = (
        "none" if value is None else f"{value:.3f}"
        for value in (
            row[f"{column}_ms"],
            row.get(f"stock_{column}_ms"),
            row.get(f"{column}_ratio"),
        )
    )
    return f"{mine} / {theirs}: {ratio}" if f"{column}_ratio" in row else mine


def main() -> None:
    """Measure, print the table, and write the figures."""
    defaults = {
        "device": "cuda" if torch.cuda.is_available() else "cpu",
        "num_envs": "4096",
        "go1": "auto",
        "only": "all",
    }
    given = command_line.options(sys.argv[1:], defaults)
    check_choice("go1", given["go1"], ("auto", "true", "false"))
    check_choice("only", given["only"], ("all", "go1"))
    device = checked_device(given["device"])
    num_envs = command_line.whole_number("num_envs", given["num_envs"])
    if device.type == "cpu":
        torch.set_num_threads(1)
    only_go1 = given["only"] == "go1"
    rows = {} if only_go1 else measure(num_envs, device)
    if rows:
        Console(width=140).print(_table(rows, num_envs, device))
    prefix = f"{report.device_label(device)}/{num_envs}"
    figures: dict[str, float] = {}
    for name, row in rows.items():
        figures |= {
            f"{prefix}/{name}/{column}": round(v, 6) for column, v in row.items() if v is not None
        }
    for column in ("step_ratio", "env_ratio", "captured_ratio"):
        found = [ratio for row in rows.values() if (ratio := row.get(column)) is not None]
        if found:
            figures[f"{prefix}/largest_{column}"] = round(max(found), 4)
    if only_go1 or given["go1"] == "true" or (given["go1"] == "auto" and device.type == "cuda"):
        go1 = measure_go1(num_envs, device)
        print({name: round(value, 5) for name, value in go1.items()})
        figures |= {f"{prefix}/{name}": round(value, 6) for name, value in go1.items()}
        if device.type == "cuda":
            figures["chain_share_of_go1_step"] = round(go1["chain_share_of_go1_step"], 6)
    path = report.write(
        "transforms",
        figures=figures,
        device=device,
        module="benchmarks.transforms",
        nearest={name: pair.nearest for name, pair in PAIRS.items()},
    )
    print(f"written to {path}")


if __name__ == "__main__":
    command_line.run(main)
