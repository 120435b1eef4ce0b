"""Simulates many worlds of one MuJoCo model together, whose states are torch tensors.

This engine knows nothing of learning: it needs torch, numpy, jaxtyping, MuJoCo, MuJoCo Warp and Warp. `World` says how
worlds are stepped, read, written and reset; the names below are all that a program needs:

    model = load_model("robot.xml")
    world = World(model, num_envs=4096, device="cuda", sim=SimCfg(timestep=0.002))
    world.ctrl_EL[:] = ...       # a row for each world; views are changed in place
    world.step(10)
    world.qpos_EL                # the state that is reached
    world.reset(fallen_E)        # puts the worlds back where the mask is true
    world.refresh()              # brings poses and sensors to the present state
    world.overflow_report().ok   # whether no contact and no constraint was dropped

With `SimCfg(engine="c")` MuJoCo's C engine computes the same worlds on the CPU, in float64. `examples/worlds.py` is a
program of this kind.
"""

from ksim_rl.device.capture import Captured
from ksim_rl.device.kernel_loading import compile_notice
from ksim_rl.physics.c_engine.c_world import CWorld
from ksim_rl.physics.fields import prepare_spec
from ksim_rl.physics.load import load_model, load_spec
from ksim_rl.physics.mujoco_warnings import show_warnings
from ksim_rl.physics.nan_guard.guard import NanGuardCfg, NanReport
from ksim_rl.physics.overflow import OverflowReport
from ksim_rl.physics.ray_casting import BatchCamera, RayBatch
from ksim_rl.physics.sim_cfg import SimCfg
from ksim_rl.physics.substep_plan import SubstepPlan
from ksim_rl.physics.warp_world import WarpWorld
from ksim_rl.physics.world import World

__all__ = [
    "BatchCamera",
    "CWorld",
    "Captured",
    "NanGuardCfg",
    "NanReport",
    "OverflowReport",
    "RayBatch",
    "SimCfg",
    "SubstepPlan",
    "WarpWorld",
    "World",
    "compile_notice",
    "load_model",
    "load_spec",
    "prepare_spec",
]

# Before any model is stepped, in whatever process.
show_warnings()
