"""Which constraint solver a world takes, and how its loop is captured."""

import mujoco
import mujoco_warp as mjw

from ksim_rl.physics.newton import solver as newton
from ksim_rl.physics.sim_cfg import SimCfg

# MuJoCo Warp's solver ends its loop by a conditional node, which costs more than the few iterations that it saves
# (H200, 4096 worlds, at most 10 iterations: Go1 8.22 ms without and 8.46 with it, G1 9.88 and 10.17).
MOST_UNCONDITIONAL_ITERATIONS = 10


def one_kernel_unavailable(mj_model: mujoco.MjModel, sim: SimCfg, *, njmax: int) -> str | None:
    """Return why the worlds of this model take MuJoCo Warp's own solver, or None where one kernel solves them."""
    if not sim.one_kernel_solver:
        return "sim.one_kernel_solver is False"
    if sim.deterministic:
        return "sim.deterministic is True"
    return newton.unsuited(mj_model, njmax=njmax)


def takes_conditional_nodes(warp_model: mjw.Model, *, supported: bool) -> bool:
    """Whether the loop of MuJoCo Warp's own solver is to end when all worlds have converged."""
    return supported and int(warp_model.opt.iterations) > MOST_UNCONDITIONAL_ITERATIONS
