"""Compares the contacts of each pair of geom kinds with MuJoCo's C engine.

    python -m benchmarks.narrow_phase [worlds=256] [depth=0.005] [margin=1e-6] [poses=any] [device=cpu]

Two geoms of about 10 cm, turned at random, are brought together along a random direction until they touch in the C
engine, and then by up to `depth`, m, further. With `poses=upright` they are turned about the vertical only, and the
second one stands on the first. Of each pair it prints the share of worlds with as many contacts as in C, and within
what the depth and the normal of the deepest contact lie in 99 of 100 worlds. Figures go to
benchmarks/results/narrow_phase.json. One of the geoms has a margin: at exactly 0, contacts of C's own with height
fields are wrong (docs/upstream.md).
"""

from __future__ import annotations

import itertools
import sys

import mujoco
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from ksim_rl.checks import check_choice
from ksim_rl.device.streams import checked_device
from ksim_rl.physics import SimCfg
from ksim_rl.physics.warp_world import WarpWorld

ROWS = 9
ASSETS = f"""
<asset>
  <mesh name="wedge" vertex="-.1 -.1 -.1 .1 -.1 -.1 0 .12 -.1 0 0 .15 .05 .05 .1"/>
  <hfield name="hills" nrow="{ROWS}" ncol="{ROWS}" size="1 1 0.15 0.5"/>
</asset>
"""
GROUNDS = {"plane": 'type="plane" size="2 2 1"', "hfield": 'type="hfield" hfield="hills"'}
SHAPES = {
    "sphere": 'type="sphere" size="0.08"',
    "capsule": 'type="capsule" size="0.05 0.08"',
    "ellipsoid": 'type="ellipsoid" size="0.06 0.08 0.1"',
    "cylinder": 'type="cylinder" size="0.07 0.08"',
    "box": 'type="box" size="0.06 0.08 0.1"',
    "mesh": 'type="mesh" mesh="wedge"',
}
PAIRS = [*itertools.product(GROUNDS, SHAPES), *itertools.combinations_with_replacement(SHAPES, 2)]
FAR, HALVINGS = 1.0, 30


def main() -> None:
    """Compare, print the table, and write the figures."""
    defaults = {
        "worlds": "256",
        "depth": "0.005",
        "margin": "1e-6",
        "poses": "any",
        "device": "cpu",
    }
    given = command_line.options(sys.argv[1:], defaults)
    check_choice("poses", given["poses"], ("any", "upright"))
    worlds = command_line.whole_number("worlds", given["worlds"])
    device = checked_device(given["device"])
    conditions = (
        f"{given['poses']} poses, up to {given['depth']} m deep, margin {given['margin']} m"
    )
    table = Table(title=f"{worlds} worlds, {conditions}")
    label = f"{report.device_label(device)}/{given['poses']}/margin_{given['margin']}"
    columns = ("pair", "as many contacts", "depth within, mm", "normal within, degrees")
    for column in columns:
        table.add_column(column)
    figures: dict[str, float] = {}
    for pair in PAIRS:
        mj_model = model(*pair, margin=float(given["margin"]))
        pose_EL = touching(
            mj_model, worlds, depth=float(given["depth"]), upright=given["poses"] == "upright"
        )
        found = compared(mj_model, pose_EL, device)
        table.add_row("-".join(pair), *(f"{value:.3g}" for value in found.values()))
        figures |= {
            f"{label}/{'-'.join(pair)}/{name}": round(value, 6) for name, value in found.items()
        }
    Console().print(table)
    path = report.write(
        "narrow_phase", figures=figures, device=device, module="benchmarks.narrow_phase"
    )
    print(f"written to {path}")


def model(one: str, other: str, *, margin: float) -> mujoco.MjModel:
    """Return two geoms; the second is free, and so is the first unless it is ground."""
    first = (
        f"<geom {GROUNDS[one]}/>"
        if one in GROUNDS
        else f"<body><freejoint/><geom {SHAPES[one]}/></body>"
    )
    xml = f"""<mujoco><option gravity="0 0 0"/>{ASSETS}<worldbody>{first}
    <body><freejoint/><geom {SHAPES[other]} margin="{margin}"/></body></worldbody></mujoco>"""
    spec = mujoco.MjSpec.from_string(xml)
    spec.hfield("hills").userdata = np.random.default_rng(0).uniform(size=ROWS * ROWS).tolist()
    return spec.compile()


def touching(mj_model: mujoco.MjModel, worlds: int, *, depth: float, upright: bool) -> torch.Tensor:
    """Draw poses in which the geoms are in each other by up to `depth`, m, along a direction, float32 [worlds, nq]."""
    rng, mj_data = np.random.default_rng(0), mujoco.MjData(mj_model)
    poses = np.tile(mj_model.qpos0, (worlds, 1))
    on_ground = mj_model.nq == 7
    for qpos in poses:
        for first in range(3, mj_model.nq, 7):
            quat = rng.normal(size=4) * ([1.0, 0.0, 0.0, 1.0] if upright else [1.0, 1.0, 1.0, 1.0])
            qpos[first : first + 4] = quat / np.linalg.norm(quat)
        towards = np.array([0.0, 0.0, 1.0])
        start = np.append(rng.uniform(-0.7, 0.7, size=2), 0.0)
        if upright:
            start *= 0.05
        elif not on_ground:
            towards, start = rng.normal(size=3), np.zeros(3)
        towards /= np.linalg.norm(towards)
        low, high = 0.0, FAR
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            mj_data.qpos[:] = qpos
            mj_data.qpos[-7:-4] = start + middle * towards
            mujoco.mj_fwdPosition(mj_model, mj_data)
            if mj_data.ncon:
                low = middle
            else:
                high = middle
        qpos[-7:-4] = start + (low - rng.uniform(0.05, 1.0) * depth) * towards
    return torch.tensor(poses, dtype=torch.float32)


def compared(
    mj_model: mujoco.MjModel, pose_EL: torch.Tensor, device: torch.device
) -> dict[str, float]:
    """Return the share of worlds with as many contacts as in C, and errors of the deepest contact in 99 of 100."""
    sim = SimCfg(njmax=400, nconmax=60, one_kernel_dynamics=True)
    world = WarpWorld(mj_model, num_envs=len(pose_EL), device=device, sim=sim)
    world.qpos_EL.copy_(pose_EL)
    world.step()
    contact, count = world.warp_data_E.contact, int(world.warp_data_E.nacon.numpy()[0])
    owner, dist, frame = (
        getattr(contact, name).numpy()[:count] for name in ("worldid", "dist", "frame")
    )
    mj_data, as_many, depths, angles = mujoco.MjData(mj_model), 0, [], []
    for row, qpos in enumerate(pose_EL.double().numpy()):
        mj_data.qpos[:] = qpos
        mujoco.mj_fwdPosition(mj_model, mj_data)
        mine = np.flatnonzero(owner == row)
        as_many += len(mine) == mj_data.ncon
        if not len(mine) or not mj_data.ncon:
            depths.append(np.inf)
            angles.append(180.0)
            continue
        own, theirs = mine[dist[mine].argmin()], int(mj_data.contact.dist.argmin())
        depths.append(1e3 * abs(dist[own] - mj_data.contact.dist[theirs]))
        cosine = np.clip(frame[own, 0] @ mj_data.contact.frame[theirs, :3], -1.0, 1.0)
        angles.append(float(np.degrees(np.arccos(cosine))))
    within = {"depth_mm": depths, "normal_degrees": angles}
    return {"as_many": as_many / len(pose_EL)} | {
        name: float(np.quantile(values, 0.99, method="higher")) for name, values in within.items()
    }


if __name__ == "__main__":
    main()
