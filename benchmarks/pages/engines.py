"""Makes the table of docs/speed.md that sets MuJoCo's C engine beside MuJoCo Warp on the CPU."""

from benchmarks.pages.committed import results
from benchmarks.pages.table import table

TASKS = {
    "cartpole": "cartpole_balance",
    "quadruped": "quadruped_velocity_flat",
    "Go1": "go1_velocity_flat",
}
NUM_ENVS = (64, 512, 4096)
HEAD = (
    "task, envs",
    "physics, wall clock",
    "processor time",
    "rollout with policy, wall clock",
    "processor time",
)


def engines() -> str:
    """Return how much faster the C engine is, by task and number of envs."""
    figures = results("throughput")["figures"]
    rows = []
    for label, task in TASKS.items():
        for num_envs in NUM_ENVS:
            row = [f"{label}, {num_envs}"]
            for name in ("physics", "rollout"):
                faster = f"cpu/{task}/{num_envs}/{name}_c_over_warp"
                row.append(f"{figures[faster]:.2f}")
                row.append(f"{figures[f'{faster}_processor_time']:.2f}")
            rows.append(row)
    return table(HEAD, rows)
