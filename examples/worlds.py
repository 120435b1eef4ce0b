"""Arms of different masses reach for an angle side by side: MuJoCo worlds as torch tensors.

    python examples/worlds.py                  # MuJoCo Warp, on the GPU where there is one
    python examples/worlds.py --engine c       # MuJoCo's C engine, on the CPU

This needs the engine alone: torch, MuJoCo, MuJoCo Warp and Warp. E is the number of worlds.
"""

import argparse
from typing import Literal

import torch
from jaxtyping import Float32
from torch import Tensor

from ksim_rl.physics import SimCfg, World, load_model

MODEL = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder"/>
  </actuator>
</mujoco>
"""
TARGET = 1.2  # rad; the arm hangs straight down at 0
STIFFNESS, DAMPING = 20.0, 4.0  # of the controller, N m/rad and N m s/rad
SUBSTEPS = 5  # steps of physics between two commands: 100 commands a second


def reach(
    *,
    engine: Literal["warp", "c"] = "warp",
    num_worlds: int = 256,
    seconds: float = 3.0,
    device: str = "cpu",
) -> tuple[Float32[Tensor, " E"], Float32[Tensor, " E"]]:
    """Return the mass of each world's arm, in kg, and by how many rad it stays below the target."""
    mj_model = load_model(MODEL)
    world = World(
        mj_model,
        num_envs=num_worlds,
        device=device,
        sim=SimCfg(engine=engine),
        # These may differ between worlds. All other constants of the model exist once.
        per_world_fields=("body_mass", "body_inertia"),
    )

    # A field is a tensor with a row for each world, named as MuJoCo names it.
    arm = mj_model.body("arm").id
    scale_E = torch.linspace(0.5, 2.0, num_worlds, device=world.device)
    world.field("body_mass")[:, arm] *= scale_E
    world.field("body_inertia")[:, arm] *= scale_E[:, None]
    # MuJoCo derives other constants from them, which only change here.
    world.set_const(["body_mass", "body_inertia"])

    # State and controls are views: what is written here is what the next step starts from.
    world.qpos_EL[:, 0] = torch.linspace(-1.0, 1.0, num_worlds, device=world.device)
    world.refresh()
    commands = round(seconds / (SUBSTEPS * world.timestep))
    for _ in range(commands):
        world.ctrl_EL[:] = STIFFNESS * (TARGET - world.qpos_EL) - DAMPING * world.qvel_EL
        world.step(SUBSTEPS)

    # Contacts and constraint rows have limits on the GPU. Nothing is dropped without a word here.
    report = world.overflow_report()
    if not report.ok:
        raise RuntimeError("; ".join(report.messages))
    mass_E = world.field("body_mass")[:, arm].clone()
    sag_E = TARGET - world.qpos_EL[:, 0]
    return mass_E, sag_E


def main() -> None:
    """Print how far some of the arms sag."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--engine", choices=("warp", "c"), default="warp")
    engine = parser.parse_args().engine
    on_gpu = engine == "warp" and torch.cuda.is_available()
    mass_E, sag_E = reach(engine=engine, device="cuda" if on_gpu else "cpu")
    for world in range(0, len(mass_E), 51):
        print(
            f"world {world:3d}: an arm of {mass_E[world]:.2f} kg stays {sag_E[world]:.3f} rad below the target"
        )


if __name__ == "__main__":
    main()
