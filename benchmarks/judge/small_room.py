"""Checks that worlds with too little room for their constraint rows say so."""

import dataclasses
from collections.abc import Sequence

import mujoco

from benchmarks.judge.comparison import Finding
from benchmarks.judge.worlds import Arrays, put, put_all
from ksim_rl.physics.capacity import capacities
from ksim_rl.physics.warp_world import WarpWorld

# Rows and contacts that there is room for, and so many rows more are surely needed: few models need none.
ROWS, CONTACTS, MORE = 5, 2, 4


def rows_of(mj_model: mujoco.MjModel, states: Sequence[Arrays]) -> list[int]:
    """Return how many constraint rows C makes in each state."""
    needed = []
    for state in states:
        mj_data = put(state, mj_model)
        mujoco.mj_forward(mj_model, mj_data)
        needed.append(mj_data.nefc)
    return needed


def untold_overflow(beside: WarpWorld, states: Sequence[Arrays]) -> tuple[Finding, ...] | None:
    """Step worlds with little room, and return what they did not say; None where they need no more than that.

    Args:
        beside: worlds with the same model and settings, which have room.
        states: of the worlds.
    """
    # Without fields of their own, in which C would find other rows.
    mj_model = beside.mj_model
    needed = rows_of(mj_model, states)
    small = dataclasses.replace(beside.sim, njmax=ROWS, nconmax=CONTACTS)
    # The integrator "discrete" has room for a few rows more than were asked for.
    room, _ = capacities(mj_model, small)
    if max(needed) < room + MORE:
        return None
    world = WarpWorld(mj_model, num_envs=len(states), device=beside.device, sim=small)
    put_all(world, list(states))
    world.step(1)
    report = world.overflow_report()
    world.close()
    if not report.ok:
        return ()
    row = needed.index(max(needed))
    return (
        Finding(
            quantity="overflow untold",
            error=float(needed[row]),
            limit=float(room),
            world=row,
            when="step(1) in worlds with little room",
        ),
    )
