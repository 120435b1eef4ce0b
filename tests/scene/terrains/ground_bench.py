"""A few worlds of a ball and a box on a small terrain, and the C engine's answer for each world."""

import mujoco
import numpy as np
import torch

from ksim_rl.envs.driver import EnvDriver
from ksim_rl.physics import SimCfg, World, load_model
from ksim_rl.scene.terrains import (
    FlatPatch,
    PyramidSlope,
    PyramidStairs,
    RoughGround,
    SteppingStones,
    TerrainGrid,
)

RADIUS, EDGE = 0.1, 0.16
# Without a margin C's contacts of boxes with height fields are less deep than they are (docs/upstream.md).
THINGS = f"""
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="ball" pos="0 0 {RADIUS}">
      <freejoint/>
      <geom name="ball" type="sphere" size="{RADIUS}" mass="2" condim="6" friction="1 0.02 0.02"/>
      <site name="ball"/>
    </body>
    <body name="box" pos="0 1 {EDGE / 2}">
      <freejoint/>
      <geom name="box" type="box" size="{EDGE / 2} {EDGE / 2} {EDGE / 2}" mass="1" margin="1e-6"/>
    </body>
  </worldbody>
</mujoco>
"""
GRID = TerrainGrid(
    patches={
        "flat": FlatPatch(cell=2.0),
        "stairs": PyramidStairs(platform_width=0.8, inverted=True),
        "slope": PyramidSlope(platform_width=0.8),
        "rough": RoughGround(),
        "stones": SteppingStones(platform_width=0.8),
    },
    num_levels=3,
    num_columns=5,
    size=4.0,
    max_initial_level=2,
    spawn_width=0.6,
)
NUM_ENVS = 15
"""One env for each level and kind of `GRID`."""
ROOM = SimCfg(njmax=120, nconmax=40)


class GroundBench:
    """Worlds, their view and their ground; `mj_model(row)` is the C engine's model of one of them."""

    def __init__(
        self,
        grid: TerrainGrid = GRID,
        num_envs: int = NUM_ENVS,
        things: str = THINGS,
        sim: SimCfg = ROOM,
    ) -> None:
        spec = mujoco.MjSpec.from_string(things)
        grid.add_to(spec)
        self.world = World(
            load_model(spec), num_envs=num_envs, sim=sim, per_world_fields=grid.per_world_fields
        )
        self.driver = EnvDriver(self.world, step_dt=0.02, max_episode_length=500)
        self.view = self.driver.view
        self.driver.ground = self.ground = grid.ground(self.view)
        self.geom = self.world.mj_model.geom("terrain").id

    def mj_model(self, row: int) -> mujoco.MjModel:
        """Return the model whose terrain geom has the height field of one world, by its name."""
        level, column = (
            int(self.ground.levels_E[row]),
            row * GRID.num_columns // self.world.num_envs,
        )
        spec = mujoco.MjSpec.from_string(THINGS)
        GRID.add_to(spec)
        spec.geom("terrain").hfieldname = f"terrain_{level}_{column}"
        return spec.compile()

    def place(self, ball_E3: torch.Tensor, box_E3: torch.Tensor) -> None:
        """Put ball and box somewhere, upright and at rest."""
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(self.world.num_envs, 4)
        self.world.qpos_EL.copy_(torch.cat((ball_E3, upright, box_E3, upright), dim=-1))
        self.world.qvel_EL.zero_()
        self.world.refresh()
        self.driver.refreshed()

    def mj_data(self, row: int, mj_model: mujoco.MjModel) -> mujoco.MjData:
        """Return the C engine's data at the present state of one world, after its forward pass."""
        mj_data = mujoco.MjData(mj_model)
        mj_data.qpos[:], mj_data.qvel[:] = (
            self.world.qpos_EL[row].numpy(),
            self.world.qvel_EL[row].numpy(),
        )
        mujoco.mj_forward(mj_model, mj_data)
        return mj_data


def ground_heights(mj_model: mujoco.MjModel, points_N2) -> np.ndarray:
    """Return the heights of the terrain at x, y [N, 2] by rays of the C engine, straight down."""
    mj_data, geom = mujoco.MjData(mj_model), mj_model.geom("terrain").id
    mujoco.mj_kinematics(mj_model, mj_data)
    down, heights = np.array([0.0, 0.0, -1.0]), []
    for x, y in points_N2:
        distance = mujoco.mj_rayHfield(mj_model, mj_data, geom, np.array([x, y, 10.0]), down, None)
        assert distance >= 0
        heights.append(10.0 - distance)
    return np.array(heights)
