"""Several entities in one scene, each against MuJoCo's C engine at random states."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ksim_rl.envs import MjcfRobot, SceneCfg
from ksim_rl.envs.driver import EnvDriver
from ksim_rl.physics import World, load_model
from ksim_rl.scene.scene import Placement, build_spec
from tests.envs.random_states import FIXED_BASE, E, close, engine, velocity
from tests.mdp.bench import FREE_BODY

CUBE = """
<mujoco>
  <worldbody>
    <body name="box" pos="0 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="1"/></body>
  </worldbody>
</mujoco>
"""
QUARTER_TURN = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
ROOTS = {
    "left": "left/trunk",
    "right": "right/trunk",
    "turret": "turret/turret",
    "cube": "cube/box",
}
SCENE = SceneCfg(
    robots={
        "left": MjcfRobot(source=FREE_BODY),
        "turret": MjcfRobot(source=FIXED_BASE),
        "right": MjcfRobot(source=FREE_BODY),
    },
    objects={"cube": MjcfRobot(source=CUBE)},
    placements={"right": Placement(pos=(10.0, 0.0, 0.5), quat=QUARTER_TURN)},
)


@pytest.fixture(scope="module")
def scene():
    """All entities at random poses and velocities; tests that write restore nothing, and check rows only."""
    world = World(load_model(build_spec(SCENE)), num_envs=E)
    model, rng = world.mj_model, np.random.default_rng(0)
    qpos = rng.normal(0.0, 0.5, (E, model.nq))
    for start in (
        *(int(a) + 3 for a in model.jnt_qposadr[model.jnt_type == 0]),
        *model.jnt_qposadr[model.jnt_type == 1],
    ):
        qpos[:, start : start + 4] /= np.linalg.norm(
            qpos[:, start : start + 4], axis=1, keepdims=True
        )
    world.qpos_EL.copy_(torch.tensor(qpos))
    world.qvel_EL.copy_(torch.tensor(rng.normal(0.0, 1.5, (E, model.nv))))
    world.refresh()
    driver = EnvDriver(world, step_dt=0.02, entities=tuple(SCENE.entities))
    return SimpleNamespace(world=world, driver=driver, view=driver.view, model=model)


@pytest.mark.parametrize("name", ROOTS)
def test_root_pose_and_velocity_of_each_entity(scene, name):
    entity, body = scene.view.entity(name), scene.model.body(ROOTS[name]).id
    assert (entity.root.id, entity.root.name) == (body, ROOTS[name])
    assert entity.free_root == (name != "turret")

    close(entity.root_pos_EL, engine(scene, lambda m, d: d.xpos[body]))
    same_sign = torch.sign(
        (entity.root_quat_EL * engine(scene, lambda m, d: d.xquat[body])).sum(-1, keepdim=True)
    )
    close(entity.root_quat_EL * same_sign, engine(scene, lambda m, d: d.xquat[body]))
    down = engine(scene, lambda m, d: d.xmat[body].reshape(3, 3).T @ [0.0, 0.0, -1.0])
    close(entity.projected_gravity_EL, down)
    close(
        entity.heading_E, engine(scene, lambda m, d: math.atan2(d.xmat[body][3], d.xmat[body][0]))
    )
    for part, in_world, in_body in (
        ("linear", entity.root_lin_vel_w_EL, entity.root_lin_vel_b_EL),
        ("angular", entity.root_ang_vel_w_EL, entity.root_ang_vel_b_EL),
    ):
        close(in_world, engine(scene, lambda m, d, part=part: velocity(m, d, [body], part=part)[0]))
        rotated = engine(
            scene,
            lambda m, d, part=part: (
                d.xmat[body].reshape(3, 3).T @ velocity(m, d, [body], part=part)[0]
            ),
        )
        close(in_body, rotated)


def test_the_views_root_is_the_first_robots(scene):
    view = scene.view
    assert view.entity() is view.entity("left")
    for name in (
        "root_pos_EL",
        "root_lin_vel_b_EL",
        "root_ang_vel_w_EL",
        "projected_gravity_EL",
        "heading_E",
    ):
        assert getattr(view, name) is getattr(view.entity("left"), name)
        assert not torch.equal(getattr(view, name), getattr(view.entity("right"), name))


def test_joints_of_an_entity_are_its_columns_of_the_views(scene):
    view = scene.view
    names = view.joints().names
    assert [name for name in names if name.startswith("right/")] == list(
        view.entity("right").joints.names
    )
    for name, own in (
        ("left", ["left/left_hip", "left/right_hip"]),
        ("turret", ["turret/pan", "turret/reach"]),
    ):
        entity = view.entity(name)
        assert torch.equal(entity.joints.pos_EL, view.joints(own).pos_EL)
        assert torch.equal(entity.joints.vel_EL, view.joint_vel_EL[:, entity.joints.index])
    assert view.entity("cube").joints.pos_EL.shape == (E, 0)


def test_entities_start_where_their_models_and_placements_say(scene):
    view = scene.view
    assert view.entity("left").default_root_pos_L.tolist() == [1.0, 2.0, 3.0]
    # The keyframe (1, 2, 3), turned by 90 degrees about z and moved by (10, 0, 0.5).
    close(view.entity("right").default_root_pos_L, torch.tensor([8.0, 1.0, 3.5]))
    close(view.entity("right").default_root_quat_L, torch.tensor(QUARTER_TURN))
    close(view.entity("turret").default_root_pos_L, torch.tensor([0.3, -0.2, 0.7]))
    close(view.entity("cube").default_root_pos_L, torch.tensor([0.0, 0.0, 0.1]))
    assert view.entity("right").joints.default_pos_EL[0].tolist() == [0.25, 0.5]


def test_writes_change_one_entity_in_the_masked_rows(scene):
    world, cube = scene.world, scene.view.entity("cube")
    mask_E = torch.arange(E) % 2 == 1
    qpos, qvel = world.qpos_EL.clone(), world.qvel_EL.clone()
    pos, quat = torch.randn(E, 3), torch.nn.functional.normalize(torch.randn(E, 4), dim=-1)
    lin, ang = torch.randn(E, 3), torch.randn(E, 3)
    cube.write_root_pose(mask_E, pos, quat)
    cube.write_root_velocity(mask_E, lin, ang)
    for after, before, own in (
        (world.qpos_EL, qpos, cube.root_qpos),
        (world.qvel_EL, qvel, cube.root_qvel),
    ):
        unchanged = torch.ones_like(after, dtype=torch.bool)
        unchanged[mask_E, own] = False
        assert torch.equal(after[unchanged], before[unchanged])
    world.refresh()
    scene.driver.refreshed()
    body = cube.root.id
    close(engine(scene, lambda m, d: d.xpos[body])[mask_E], pos[mask_E])
    close(engine(scene, lambda m, d: velocity(m, d, [body], part="linear")[0])[mask_E], lin[mask_E])
    close(
        engine(scene, lambda m, d: velocity(m, d, [body], part="angular")[0])[mask_E], ang[mask_E]
    )
    close(cube.root_ang_vel_w_EL[mask_E], ang[mask_E])


def test_a_fixed_root_is_not_written(scene):
    everybody_E = torch.ones(E, dtype=torch.bool)
    pos, quat = torch.zeros(E, 3), torch.zeros(E, 4)
    with pytest.raises(
        ValueError,
        match="write_root_pose of 'turret': its root body 'turret/turret' has no free joint",
    ):
        scene.view.entity("turret").write_root_pose(everybody_E, pos, quat)
    with pytest.raises(ValueError, match="write_root_velocity of 'turret'"):
        scene.view.entity("turret").write_root_velocity(everybody_E, pos, pos)


def test_a_derived_pose_after_a_write_is_refused_for_every_entity(scene):
    view = scene.view
    cube, turret = view.entity("cube"), view.entity("turret")
    before = cube.heading_E
    assert cube.heading_E is before, "computed once"
    view.entity("right").write_root_pose(
        torch.ones(E, dtype=torch.bool), torch.zeros(E, 3), cube.root_quat_EL
    )
    assert cube.heading_E is not before, "any write clears every entity's quantities"
    with pytest.raises(RuntimeError, match="derived"):
        _ = turret.root_lin_vel_w_EL
    scene.world.refresh()
    scene.driver.refreshed()
    assert turret.root_lin_vel_w_EL.shape == (E, 3)


def test_unknown_names_list_the_near_ones(scene):
    with pytest.raises(
        ValueError, match="no entity 'cub' in scene.robots and scene.objects: did you mean 'cube'"
    ):
        scene.view.entity("cub")
