"""Makes the table of docs/vision.md with the frames per second of cameras on a GPU."""

from benchmarks.pages.committed import results
from benchmarks.pages.table import table

TASKS = {
    "cartpole": "cartpole_balance",
    "Go1": "go1_velocity_flat",
    "G1 (capsules)": "g1_velocity_flat",
}
PICTURES = {"RGB": "", "depth": "depth_"}
NUM_ENVS = 4096
SIZE = 64
HEAD = (
    "task, picture",
    "MuJoCo Warp's renderer",
    "drawn by the env",
    "in a rollout",
    "in training",
)


def cameras() -> str:
    """Return the frames per second of each task and kind of picture."""
    figures = results("cameras")["figures"]
    rows = []
    for label, task in TASKS.items():
        for kind, prefix in PICTURES.items():
            row = [f"{label}, {kind}"]
            for stage in ("renderer", "drawn", "rollout", "training"):
                frames = figures[f"h200/{task}/{NUM_ENVS}/{SIZE}/{prefix}{stage}_frames_per_s"]
                row.append(f"{frames:,.0f}")
            rows.append(row)
    return table(HEAD, rows)
