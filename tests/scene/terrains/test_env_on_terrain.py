"""An env on a terrain grid: where it starts, what its curriculum keeps, and what its pictures show."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.envs import (
    ManagerBasedRlEnv,
    ManagerBasedRlEnvCfg,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    SceneCfg,
    ViewerCfg,
)
from ksim_rl.mdp import (
    HeightScan,
    JointEffortAction,
    OutsideTerrain,
    ResetRootOnEvenGround,
    ResetRootUniform,
    RootPos,
    TerrainLevels,
    UniformVelocityCommand,
)
from ksim_rl.physics import SimCfg
from ksim_rl.scene.rendering import rendering
from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.terrains import PyramidSlope, PyramidStairs
from ksim_rl.testing import check_env
from tests.scene.terrains.ground_bench import GRID

WALKER = """
<mujoco>
  <worldbody>
    <body name="ball" pos="0 0 0.1">
      <freejoint/>
      <geom type="sphere" size="0.1" mass="1"/>
      <body name="arm"><joint name="arm"/><geom type="capsule" size="0.02 0.05" pos="0 0 0.2" mass="0.1"/></body>
    </body>
  </worldbody>
  <actuator><motor name="arm" joint="arm"/></actuator>
</mujoco>
"""
NUM_ENVS = 10
TURN = {"pose_range": {"x": (-0.2, 0.2), "z": (0.02, 0.05)}}


def walker_env(render_mode=None, viewer=None, **fields) -> ManagerBasedRlEnv:
    scan = ObservationTermCfg(term=HeightScan(size=(0.4, 0.4), resolution=0.2, offset=0.1))
    group = ObservationGroupCfg(terms={"pos": ObservationTermCfg(term=RootPos()), "scan": scan})
    command = UniformVelocityCommand(
        resampling_time_range_s=(5.0, 5.0),
        lin_vel_x=(1.0, 1.0),
        lin_vel_y=(0.0, 0.0),
        ang_vel_z=(0.0, 0.0),
    )
    defaults = {
        "events": {"start": ResetRootUniform(**TURN)},
        "scene": SceneCfg(
            robots={"walker": MjcfRobot(source=WALKER)},
            terrain=GRID,
            num_envs=NUM_ENVS,
            spacing=GRID.size,
        ),
    }
    return ManagerBasedRlEnv(
        ManagerBasedRlEnvCfg(
            decimation=2,
            sim=SimCfg(timestep=0.005, njmax=60, nconmax=20),
            observations={"actor": group},
            actions={"swing": JointEffortAction()},
            commands={"twist": command},
            terminations={"outside": OutsideTerrain()},
            curriculum={"terrain_level": TerrainLevels(command="twist")},
            episode_length_s=4.0,
            seed=1,
            viewer=viewer or ViewerCfg(),
            **(defaults | fields),
        ),
        render_mode=render_mode,
    )


@pytest.fixture(scope="module")
def env():
    return walker_env()


def step(env, root_E, times=1):
    for _ in range(times):
        _, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(NUM_ENVS, 1)))
    return root_E


def test_it_passes_the_checks_of_every_env():
    check_env(walker_env())


def test_episodes_start_on_the_ground(env):
    root_E = env.reset()
    origins_E3 = env.view.terrain.origins_E3
    start_E3 = root_E["obs", "pos"] - origins_E3 - torch.tensor([0.0, 0.0, 0.1])
    assert float(origins_E3[:, 2].max()) > 0.4
    assert bool(((start_E3[:, 2] > 0.02 - 1e-5) & (start_E3[:, 2] < 0.05 + 1e-5)).all())
    assert bool((start_E3[:, 0].abs() <= 0.2).all()) and float(start_E3[:, 0].abs().max()) > 0.05
    clearance = env.view.terrain.clearance(root_E["obs", "pos"][:, None])[:, 0]
    assert bool((clearance >= 0.1 + 0.02 - 1e-5).all())


def test_without_events_the_default_pose_stands_on_the_ground():
    env = walker_env(events=None)
    expected = env.view.terrain.origins_E3 + torch.tensor([0.0, 0.0, 0.1])
    assert torch.allclose(env.reset()["obs", "pos"], expected)


def test_a_walk_over_the_edge_ends_in_a_truncation_and_a_higher_level(env):
    root_E = env.reset()
    levels_E = env.view.terrain.levels_E.clone()
    root_E = step(env, root_E, 2)
    fields = {name: value.clone() for name, value in env.world.per_world_fields().items()}
    env.world.qpos_EL[4, 0] = 1.8
    env.world.refresh()
    stepped = env.step(root_E.set("action", torch.zeros(NUM_ENVS, 1)))
    assert stepped["next", "truncated"].flatten().tolist() == [row == 4 for row in range(NUM_ENVS)]
    assert not bool(stepped["next", "terminated"].any())
    before_EL = env.world.qpos_EL.clone()
    env.reset(stepped["next"].set("_reset", stepped["next", "done"]))
    top = GRID.num_levels - 1
    others = torch.arange(NUM_ENVS) != 4
    assert int(levels_E[4]) < top and int(env.view.terrain.levels_E[4]) == int(levels_E[4]) + 1
    assert torch.equal(env.view.terrain.levels_E[others], levels_E[others])
    assert torch.equal(env.world.qpos_EL[others], before_EL[others])
    for name, value in env.world.per_world_fields().items():
        assert torch.equal(value[others], fields[name][others])
    assert float(env.curriculum_levels()["terrain_level"]) == pytest.approx(
        float(env.view.terrain.levels_E.float().mean())
    )


def test_levels_and_patches_survive_a_checkpoint(env):
    root_E = env.reset()
    env.view.terrain.set_levels(
        torch.ones(NUM_ENVS, dtype=torch.bool), 2 - torch.arange(NUM_ENVS) % 3
    )
    root_E = step(env, root_E, 3)
    levels, state = env.view.terrain.levels_E.tolist(), env.state_dict()
    expected = step(env, root_E.clone(), 5)
    other = walker_env()
    other.reset()
    assert other.view.terrain.levels_E.tolist() != levels
    other.load_state_dict(state)
    assert other.view.terrain.levels_E.tolist() == levels
    resumed = step(other, root_E.clone(), 5)
    assert torch.equal(resumed["obs", "pos"], expected["obs", "pos"])
    assert torch.equal(resumed["obs", "scan"], expected["obs", "scan"])


def test_pictures_show_the_patch_that_the_env_stands_on():
    try:
        rendering.choose_gl_platform()
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 24, 32).close()
    except Exception as error:
        pytest.skip(f"no OpenGL here: {error}")
    viewer = ViewerCfg(lookat=(0.0, 0.0, 0.5), distance=4.0, elevation=-50.0, width=64, height=48)
    pictures = {}
    for row in (0, 1, 4, 9):
        env = walker_env("rgb_array", dataclasses.replace(viewer, env_index=row), events={})
        env.view.terrain.set_levels(
            torch.ones(NUM_ENVS, dtype=torch.bool), torch.full((NUM_ENVS,), 2)
        )
        env.world.qpos_EL[:] = torch.tensor([0.0, 0.0, 9.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        env.world.refresh()
        env.driver.refreshed()
        env.cfg = dataclasses.replace(env.cfg, commands={})  # no arrows
        pictures[row] = env.render().astype(int)
        env.close()
    assert np.abs(pictures[0] - pictures[1]).mean() < 0.5  # both on flat ground
    for row in (4, 9):  # on a slope, and on stones
        assert np.abs(pictures[0] - pictures[row]).mean() > 5
    assert np.abs(pictures[4] - pictures[9]).mean() > 5


def even_env(num_envs=NUM_ENVS, **fields):
    patches = {
        "slope": PyramidSlope(gradient=(0.3, 0.3), platform_width=1.0),
        "stairs": PyramidStairs(step_width=0.6),
    }
    grid = dataclasses.replace(
        GRID, patches=patches, num_levels=2, num_columns=2, size=6.0, max_initial_level=1
    )
    event = ResetRootOnEvenGround(
        **({"edge": 0.4, "max_difference": 0.02, "num_places": 8} | fields)
    )
    scene = SceneCfg(
        robots={"walker": MjcfRobot(source=WALKER)}, terrain=grid, num_envs=num_envs, spacing=6.0
    )
    return walker_env(events={"start": event}, scene=scene)


def test_envs_start_all_over_their_patch_where_it_is_even():
    env = even_env(40)
    env.reset()
    pos_E3 = env.view.root_pos_EL.clone()
    # The highest and the lowest ground in a square about each start, point by point.
    line = torch.linspace(-0.2, 0.2, 21)
    around_N2 = torch.stack(torch.meshgrid(line, line, indexing="ij"), dim=-1).view(-1, 2)
    heights_EN = env.view.terrain.heights(pos_E3[:, None, :2] + around_N2)
    assert (heights_EN.amax(-1) - heights_EN.amin(-1) <= 0.02 + 1e-5).all()
    torch.testing.assert_close(pos_E3[:, 2], heights_EN.amax(-1) + 0.1, atol=0.02, rtol=0)
    # The slope is even on its platform alone; stairs are even on their treads, too.
    on_slope = torch.arange(40) < 20
    assert pos_E3[on_slope, :2].abs().max() <= 0.5 and pos_E3[~on_slope, :2].abs().max() > 1.2
    assert len({tuple(place) for place in pos_E3[~on_slope].tolist()}) > 8
    env.reset()
    assert not torch.equal(env.view.root_pos_EL, pos_E3)


def test_ground_without_an_even_square_is_named():
    with pytest.raises(
        ValueError, match=r"no square of 1\.5 m of level 0 of the ground 'slope' is even within"
    ):
        even_env(edge=1.5)
    with pytest.raises(
        ValueError, match="edge=7.0: the patches of the terrain have edges of 6.0 m"
    ):
        even_env(edge=7.0)
    with pytest.raises(ValueError, match="even everywhere: use ResetRootUniform"):
        Ground(2, torch.device("cpu")).places_on_even_ground(edge=1.0, max_difference=0.1, count=2)
