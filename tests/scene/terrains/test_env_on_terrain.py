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
    ResetRootUniform,
    RootPos,
    TerrainLevels,
    UniformVelocityCommand,
)
from ksim_rl.physics import SimCfg
from ksim_rl.scene.rendering import rendering
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
        resampling_time_range_s=(5.0, 5.0), lin_vel_x=(1.0, 1.0), lin_vel_y=(0.0, 0.0), ang_vel_z=(0.0, 0.0)
    )
    defaults = {
        "events": {"start": ResetRootUniform(**TURN)},
        "scene": SceneCfg(
            robots={"walker": MjcfRobot(source=WALKER)}, terrain=GRID, num_envs=NUM_ENVS, spacing=GRID.size
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
    env.view.terrain.set_levels(torch.ones(NUM_ENVS, dtype=torch.bool), 2 - torch.arange(NUM_ENVS) % 3)
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
        env.view.terrain.set_levels(torch.ones(NUM_ENVS, dtype=torch.bool), torch.full((NUM_ENVS,), 2))
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
