"""Which constraint solver a world takes, and how its loop is captured, from what was measured."""

import mujoco
import mujoco_warp as mjw
import torch

from ksim_rl.physics import newton
from ksim_rl.physics.sim_cfg import SimCfg

# On an H200 with 4096 worlds the one-kernel solver pays for Go1 (18 degrees of freedom: 5.9 ms for four substeps, not
# 7.7) and did not for G1 (35: 10.7 ms, not 9.3); on the CPU it always does (Go1: 1.5 ms, not 6.4, of 4 worlds).
MOST_DOFS_ON_CUDA = 32
# MuJoCo Warp's solver ends its loop by a conditional node, which costs more than the few iterations that it saves
# (H200, 4096 worlds, at most 10 iterations: Go1 8.22 ms without and 8.46 with it, G1 9.88 and 10.17).
MOST_UNCONDITIONAL_ITERATIONS = 10


def takes_one_kernel(mj_model: mujoco.MjModel, sim: SimCfg, *, njmax: int, device: torch.device) -> bool:
    """Whether the worlds of this model solve their constraints in one kernel."""
    if sim.one_kernel_solver is False or sim.deterministic or not newton.suits(mj_model, njmax=njmax):
        return False
    return bool(sim.one_kernel_solver) or device.type == "cpu" or mj_model.nv <= MOST_DOFS_ON_CUDA


def takes_conditional_nodes(warp_model: mjw.Model, *, supported: bool) -> bool:
    """Whether the loop of MuJoCo Warp's own solver is to end when all worlds have converged."""
    return supported and int(warp_model.opt.iterations) > MOST_UNCONDITIONAL_ITERATIONS
