"""The tables of docs/memory.md are those of benchmarks/results, or computed from them."""

import pytest

from tests.docs.guide import DOCS
from tests.docs.test_speed import G1, GO1, MEMORY, results

PAGE = (DOCS / "memory.md").read_text()


def cells(first: str) -> list[list[str]]:
    """The rows whose first cell begins so."""
    rows = [line.strip("| ").split(" | ") for line in PAGE.splitlines() if line.startswith("| ")]
    return [row[1:] for row in rows if row[0].startswith(first)]


def bytes_per_env(task: str) -> list[float]:
    figures = results("throughput")
    return [figures[f"{task}{part}_bytes_per_world"] for part in MEMORY]


@pytest.mark.parametrize(("label", "task"), [("Go1", GO1), ("G1", G1)])
def test_what_an_env_takes(label: str, task: str) -> None:
    parts = bytes_per_env(task)
    assert cells(label) == [[f"{n / 1000:.0f}" for n in (*parts, sum(parts))]]


@pytest.mark.parametrize("num_envs", [1024, 4096, 8192, 16384, 32768, 65536])
def test_what_many_envs_take(num_envs: int) -> None:
    memory = [f"{num_envs * sum(bytes_per_env(task)) / 1e9:.1f}" for task in (GO1, G1)]
    speeds = results("scaling")
    name = f"h200/go1_velocity_flat/{num_envs}/env_states_per_s"
    assert cells(str(num_envs)) == [memory, *([[f"{speeds[name] / 1e6:.2f}"]] if name in speeds else [])]


def test_what_a_cpu_trains_at() -> None:
    figure = results("throughput")["cpu/cartpole_balance/512/env_states_per_s"]
    assert f"trains at {round(figure, -2):,.0f} env states/s" in PAGE
