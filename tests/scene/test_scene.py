"""Scenes: robots, prefixes, terrain, refusals."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.envs import (
    ContactSensor,
    ManagerBasedRlEnv,
    MjcfRobot,
    Placement,
    PlaneTerrain,
    SceneCfg,
)
from ksim_rl.mdp import JointEffortAction
from ksim_rl.scene.scene import Robot, build_spec
from tests.envs.probe_env import PUCK_XML, SUBSTEP_S, puck_cfg, push

CART = """
<mujoco model="cart">
  <option timestep="0.001" gravity="0 0 -3"><flag contact="disable"/></option>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <joint name="hinge" axis="0 1 0"/>
      <geom name="cart" size="0.1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail"/></actuator>
  <keyframe><key name="start" qpos="0.25 0.5"/><key name="other" qpos="9 9"/></keyframe>
</mujoco>
"""

CUBE = """
<mujoco><worldbody><body pos="0 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body></worldbody></mujoco>
"""
TABLE = """
<mujoco>
  <worldbody>
    <geom name="top" size="0.1" pos="1 0 0.5"/>
    <frame pos="0.5 0 0"><body name="lamp"><geom size="0.1"/></body></frame>
    <body name="ball"><freejoint/><geom size="0.1"/></body>
  </worldbody>
  <keyframe><key name="start" qpos="1 2 3 1 0 0 0"/></keyframe>
</mujoco>
"""
"""A fixed geom, a fixed body inside a frame, and a free ball."""


def scene(**fields) -> mujoco.MjModel:
    return build_spec(SceneCfg(**fields)).compile()


def names(model, kind):
    count = {"body": model.nbody, "joint": model.njnt, "geom": model.ngeom, "actuator": model.nu}[
        kind
    ]
    return [getattr(model, kind)(i).name for i in range(count)]


def test_a_single_robot_keeps_its_names():
    model = scene(robots={"puck": MjcfRobot(source=PUCK_XML)})
    assert names(model, "body") == ["world", "puck"] and names(model, "joint") == ["rail"]
    assert model.opt.timestep == SUBSTEP_S


def test_several_robots_get_prefixes():
    model = scene(robots={"left": MjcfRobot(source=PUCK_XML), "right": MjcfRobot(source=CART)})
    assert names(model, "body") == ["world", "left/puck", "right/cart"]
    assert names(model, "joint") == ["left/rail", "right/rail", "right/hinge"]
    assert names(model, "actuator") == ["left/push", "right/push"]


def test_several_robots_all_start_at_their_default_poses():
    cart, puck = MjcfRobot(source=CART), MjcfRobot(source=PUCK_XML)
    model = scene(robots={"a": cart, "b": puck, "c": cart})
    assert model.nkey == 1 and model.key_qpos.tolist() == [[0.25, 0.5, 0.0, 0.25, 0.5]]


def test_objects_come_after_robots_and_are_named_like_them():
    cart, cube = MjcfRobot(source=CART), MjcfRobot(source=CUBE)
    model = scene(robots={"cart": cart}, objects={"cube": cube})
    assert names(model, "body") == ["world", "cart/cart", "cube/body0"], "an unnamed body is named"
    assert model.key_qpos.tolist() == [[0.25, 0.5, 0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]]


def test_placements_move_bodies_fixed_geoms_and_free_keyframes():
    quarter_turn = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
    placement = Placement(pos=(5.0, 0.0, 1.0), quat=quarter_turn)
    turned = np.array([*quarter_turn])
    for robots in (
        {"a": MjcfRobot(source=TABLE)},
        {"b": MjcfRobot(source=CART), "a": MjcfRobot(source=TABLE)},
    ):
        model = scene(robots=robots, placements={"a": placement})
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        prefix = "a/" if len(robots) > 1 else ""
        # (x, y, z) turns into (-y, x, z), then moves.
        np.testing.assert_allclose(data.geom(f"{prefix}top").xpos, [5.0, 1.0, 1.5], atol=1e-9)
        np.testing.assert_allclose(data.body(f"{prefix}lamp").xpos, [5.0, 0.5, 1.0], atol=1e-9)
        np.testing.assert_allclose(data.body(f"{prefix}ball").xpos, [3.0, 1.0, 4.0], atol=1e-9)
        np.testing.assert_allclose(data.body(f"{prefix}ball").xquat, turned, atol=1e-9)


def test_entities_have_names_of_their_own():
    puck = MjcfRobot(source=PUCK_XML)
    with pytest.raises(ValueError, match="objects: 'puck' is the name of a robot"):
        SceneCfg(robots={"puck": puck}, objects={"puck": puck})
    with pytest.raises(
        ValueError, match="placements: no robot or object 'pick': did you mean 'puck'"
    ):
        SceneCfg(robots={"puck": puck}, placements={"pick": Placement()})
    with pytest.raises(
        ValueError, match=r"quat=\(1\.0, 1\.0, 0\.0, 0\.0\): expected a unit quaternion"
    ):
        Placement(quat=(1.0, 1.0, 0.0, 0.0))


def test_options_of_several_robots_are_those_of_the_first(recwarn):
    cart, puck = MjcfRobot(source=CART), MjcfRobot(source=PUCK_XML)
    model = scene(robots={"a": cart, "b": puck})
    assert model.opt.timestep == 0.001 and model.opt.gravity[2] == -3.0
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert scene(robots={"a": puck, "b": cart}).opt.timestep == SUBSTEP_S
    assert not recwarn.list


def test_two_pucks_are_driven_apart():
    cfg = puck_cfg(num_envs=2, events=None, limit=None)
    puck = MjcfRobot(source=PUCK_XML)
    cfg = dataclasses.replace(
        cfg,
        scene=SceneCfg(robots={"left": puck, "right": puck}, num_envs=2),
        events=None,
        actions={"push": JointEffortAction(joints="right/rail")},
    )
    env = ManagerBasedRlEnv(cfg)
    next_E = push(env, env.reset(), force=2.0)["next"]
    torch.testing.assert_close(
        next_E["obs", "velocity"], torch.tensor([[0.0, 2.0 * env.step_dt]] * 2)
    )


def test_the_plane_is_a_body_of_its_own_with_its_friction():
    puck, terrain = MjcfRobot(source=PUCK_XML), PlaneTerrain(friction=(0.7, 0.01, 0.002))
    model = scene(robots={"puck": puck}, terrain=terrain)
    assert names(model, "body") == ["world", "puck", "terrain"]
    geom = model.geom("terrain")
    assert geom.type == mujoco.mjtGeom.mjGEOM_PLANE and geom.bodyid == model.body("terrain").id
    assert geom.friction.tolist() == [0.7, 0.01, 0.002] and geom.pos.tolist() == [0.0, 0.0, 0.0]
    assert geom.size[:2].tolist() == [0.0, 0.0], "infinite in x and y"


def test_the_plane_collides_whatever_the_robots_default_class_says():
    ghostly = PUCK_XML.replace(
        "<worldbody>",
        '<default><geom contype="0" conaffinity="0" condim="6"/></default><worldbody>',
    )
    geom = scene(robots={"puck": MjcfRobot(source=ghostly)}, terrain=PlaneTerrain()).geom("terrain")
    assert (geom.contype, geom.conaffinity, geom.condim) == (1, 1, 3)


def test_without_terrain_there_is_none():
    assert "terrain" not in names(scene(robots={"puck": MjcfRobot(source=PUCK_XML)}), "body")


def test_sensors_of_several_robots_use_the_prefixed_names():
    puck = MjcfRobot(source=PUCK_XML)
    robots, terrain = {"a": puck, "b": puck}, PlaneTerrain()
    sensors = {"touch": ContactSensor(geoms=("b/puck",))}
    model = scene(robots=robots, terrain=terrain, sensors=sensors)
    assert [model.sensor(i).name for i in range(model.nsensor)] == ["touch_b/puck"]
    with pytest.raises(
        ValueError,
        match=r"scene\.sensors\.touch: no geom matches 'puck': did you mean 'b/puck' or 'a/puck'",
    ):
        scene(robots=robots, terrain=terrain, sensors={"touch": ContactSensor(geoms=("puck",))})


def test_a_robot_is_anything_with_a_spec():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Edited:
        mass: float

        def spec(self) -> mujoco.MjSpec:
            spec = MjcfRobot(source=PUCK_XML).spec()
            spec.geom("puck").mass = self.mass
            return spec

    assert isinstance(Edited(mass=3.0), Robot)
    assert scene(robots={"puck": Edited(mass=3.0)}).body("puck").mass == 3.0


def test_a_robot_that_cannot_be_loaded_is_refused():
    with pytest.raises(ValueError, match="no such file"):
        scene(robots={"puck": MjcfRobot(source="no/such/robot.xml")})
    broken = PUCK_XML.replace('mass="1"', 'mass="-1"')
    with pytest.raises(ValueError, match="mass"):
        scene(robots={"a": MjcfRobot(source=broken), "b": MjcfRobot(source=PUCK_XML)})


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"robots": {}}, "robots={}: name at least one robot"),
        ({"num_envs": 0}, "num_envs=0: expected a whole number >= 1"),
        ({"num_envs": 2.0}, r"num_envs=2\.0"),
        ({"num_envs": True}, "num_envs=True"),
        ({"spacing": -1.0}, r"spacing=-1\.0"),
        ({"soft_joint_pos_limit_factor": 1.5}, r"soft_joint_pos_limit_factor=1\.5"),
    ],
)
def test_values_out_of_range_name_the_field(fields, message):
    with pytest.raises(ValueError, match=message):
        SceneCfg(**({"robots": {"puck": MjcfRobot(source=PUCK_XML)}} | fields))


def test_negative_friction_is_refused():
    with pytest.raises(ValueError, match=r"friction\[1\]=-0\.1"):
        PlaneTerrain(friction=(1.0, -0.1, 0.0))


PENDULUM = """
<mujoco><compiler {settings}/><option timestep="0.001"/>
  <worldbody><geom name="post" size="0.05" contype="0" conaffinity="0"/>
    <body name="a"><joint axis="0 1 0"/><geom size="0.1" pos="0.3 0 0" contype="0" conaffinity="0"/>
      <body name="b" pos="0.5 0 0"><joint axis="0 1 0"/>
        <geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0" contype="0" conaffinity="0"/></body></body></worldbody>
  <keyframe><key qpos="0.3 -0.7"/></keyframe></mujoco>
"""


@pytest.mark.parametrize(
    "settings",
    [
        'settotalmass="7"',
        'boundmass="90"',
        'boundinertia="3"',
        'settotalmass="7" inertiafromgeom="true"',
    ],
)
def test_a_part_weighs_beside_others_what_it_weighs_alone(settings):
    text = PENDULUM.format(settings=settings)
    alone = mujoco.MjModel.from_xml_string(text)
    together = scene(robots={"cart": MjcfRobot(source=CART), "arm": MjcfRobot(source=text)})
    together.opt.gravity = (0.0, 0.0, -9.81)
    ids = [together.body(f"arm/{name}").id for name in "ab"]
    np.testing.assert_allclose(together.body_mass[ids], alone.body_mass[1:], rtol=1e-12)
    np.testing.assert_allclose(together.body_inertia[ids], alone.body_inertia[1:], rtol=1e-12)
    data, own = mujoco.MjData(together), mujoco.MjData(alone)
    mujoco.mj_resetDataKeyframe(together, data, 0)
    mujoco.mj_resetDataKeyframe(alone, own, 0)
    for _ in range(500):
        mujoco.mj_step(together, data)
        mujoco.mj_step(alone, own)
    np.testing.assert_allclose(data.qpos[2:], own.qpos, rtol=1e-9)


def test_a_field_that_a_joined_model_would_change_is_refused(monkeypatch):
    attach = mujoco.MjSpec.attach

    def attach_heavier(spec, entity, **places):
        entity.body("cart").gravcomp = 0.5
        return attach(spec, entity, **places)

    monkeypatch.setattr(mujoco.MjSpec, "attach", attach_heavier)
    robots = {name: MjcfRobot(source=CART) for name in ("left", "right")}
    with pytest.raises(
        ValueError, match=r"body_gravcomp of body number 1 of 'left' is 0.0 alone and 0.5 beside"
    ):
        scene(robots=robots)
