"""Chooses the engine where the settings leave it open: by device, by the features that are asked for, and by size."""

from collections.abc import Sequence

import mujoco
import torch

from ksim_rl.physics.sim_cfg import SimCfg

# From here on C's physics takes no more processor time than Warp's, and C shares it among all cores, where Warp uses
# one (docs/speed.md#two-engines-on-the-cpu). Below, little work is done in a step: then it counts more that Warp's
# rollouts are compiled, and its steps graphs.
LEAST_DOFS = 16
LEAST_WORLDS = 512


def choose_engine(
    sim: SimCfg,
    mj_model: mujoco.MjModel,
    *,
    num_envs: int,
    device: torch.device,
    warp_alone: Sequence[str] = (),
) -> tuple[str, str]:
    """Return the engine, "warp" or "c", and why; `warp_alone` names features that are asked for and C does not have."""
    # A setting comes first, then features that only one engine has, and size at last.
    if sim.engine != "auto":
        return sim.engine, f"task.sim.engine={sim.engine}"
    if device.type != "cpu":
        return "warp", "MuJoCo's C engine runs on the CPU alone"
    if sim.one_kernel_dynamics is not None:
        return (
            "warp",
            f"task.sim.one_kernel_dynamics={str(sim.one_kernel_dynamics).lower()} is of its kernels",
        )
    if sim.require_graphs:
        return "warp", "task.sim.require_graphs=true asks for its graphs"
    if warp_alone:
        return "warp", f"MuJoCo's C engine has no {', '.join(warp_alone)}"
    rule = f"on the CPU C is taken from {LEAST_DOFS} degrees of freedom in {LEAST_WORLDS} worlds on"
    size = f"{rule}, and here are {mj_model.nv} in {num_envs}"
    if mj_model.nv >= LEAST_DOFS and num_envs >= LEAST_WORLDS:
        return "c", size
    return "warp", size
