"""Makes the tables of docs/memory.md: what an env takes, and how many envs fit."""

from benchmarks.pages.committed import results
from benchmarks.pages.table import table

PARTS = ("physics", "env_and_rollout", "update")
ROBOTS = {
    "Go1 on flat ground, 12 joints": "h200/go1_velocity_flat/4096",
    "G1 on flat ground, 29 joints": "h200/g1_velocity_flat/4096",
}
# Bytes in a frame (one per color, four per distance), and the frames of an observation.
PICTURES = {
    "64 x 64 RGB": (64 * 64 * 3, 1),
    "64 x 64 RGB, 3 frames": (64 * 64 * 3, 3),
    "64 x 64 depth": (64 * 64 * 4, 1),
    "64 x 64 depth, 3 frames": (64 * 64 * 4, 3),
    "128 x 128 RGB": (128 * 128 * 3, 1),
}
ENVS = 4096
STEPS = 24
REPLAYED = 1000
NUM_ENVS = (1024, 4096, 8192, 16384, 32768, 65536)


def bytes_per_env(robot: str) -> list[float]:
    """Return what the parts of an env take on the device."""
    figures = results("throughput")["figures"]
    return [figures[f"{ROBOTS[robot]}/{part}_bytes_per_world"] for part in PARTS]


def per_env() -> str:
    """Return the table of the parts, in kB."""
    rows = []
    for robot in ROBOTS:
        parts = bytes_per_env(robot)
        sizes = [f"{size / 1000:.0f}" for size in (*parts, sum(parts))]
        rows.append([robot, *sizes])
    return table(
        ("kB per env", "MuJoCo Warp's data", "env and rollout of 24 steps", "update", "in all"),
        rows,
    )


def of_many() -> str:
    """Return the table of the memory of many envs, in GB."""
    totals = [sum(bytes_per_env(robot)) for robot in ROBOTS]
    rows = []
    for num_envs in NUM_ENVS:
        rows.append([str(num_envs), *(f"{num_envs * total / 1e9:.1f}" for total in totals)])
    return table(("num_envs", "Go1", "G1"), rows)


def pictures() -> str:
    """Return the table of what pictures take, computed from their sizes."""
    rows = []
    for name, (frame, num_frames) in PICTURES.items():
        size = frame * num_frames
        # A rollout, and the dataset that is a copy of it; a critic that sees reads the state that follows, too.
        rollout = 2 * STEPS * ENVS * size
        # A replay holds each frame once, though it is in several stacks.
        gigabytes = [rollout, 2 * rollout, REPLAYED * ENVS * frame]
        cells = [f"{number / 1e9:.1f}" for number in gigabytes]
        rows.append([name, f"{size / 1000:.1f}", *cells])
    columns = ("kB per env state", "policy sees", "critic too", "replay")
    return table(("picture", *columns), rows)


def speed() -> str:
    """Return the table of the speed of training, over the numbers of envs that were measured."""
    figures = results("scaling")["figures"]
    rows = []
    for num_envs in NUM_ENVS:
        name = f"h200/go1_velocity_flat/{num_envs}/env_states_per_s"
        if name in figures:
            rows.append([str(num_envs), f"{figures[name] / 1e6:.2f}"])
    return table(("num_envs", "million env states/s"), rows)
