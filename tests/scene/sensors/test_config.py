"""Sensors and the NaN guard as config trees."""

import mujoco
import pytest

from ksim_rl.envs import CameraSensor, ContactSensor, ImuSensor, SceneCfg, from_tree, to_tree
from ksim_rl.physics import NanGuardCfg, SimCfg
from ksim_rl.scene.scene import MjcfRobot
from tests.envs.probe_env import PUCK_XML

SENSORS = {
    "feet": ContactSensor(geoms=("FL", "F."), every_substep=True),
    "self": ContactSensor(
        subtrees=("base",), against="base", against_kind="subtree", reduce="strongest"
    ),
    "anything": ContactSensor(bodies=("base",), against=None),
    "imu": ImuSensor(body="base", pos=(0.1, 0.0, 0.0)),
    "chip": ImuSensor(site="chip"),
    "eye": CameraSensor(body="base", depth=True, geom_groups=(0, 3)),
}


def test_sensors_survive_the_way_through_a_tree():
    cfg = SceneCfg(robots={"puck": MjcfRobot(source=PUCK_XML)}, sensors=SENSORS)
    assert from_tree(SceneCfg, to_tree(cfg)) == cfg


def test_a_tree_without_a_target_or_with_an_unknown_field_names_its_path():
    tree = to_tree(SceneCfg(robots={"puck": MjcfRobot(source=PUCK_XML)}, sensors=SENSORS))
    del tree["sensors"]["imu"]["_target_"]
    with pytest.raises(
        ValueError, match=r"scene\.sensors\.imu: needs _target_, the class of this Sensor"
    ):
        from_tree(SceneCfg, tree, "scene")
    tree = to_tree(SceneCfg(robots={"puck": MjcfRobot(source=PUCK_XML)}, sensors=SENSORS))
    tree["sensors"]["eye"]["widht"] = 3
    with pytest.raises(ValueError, match=r"unknown field 'scene\.sensors\.eye\.widht'.*'width'"):
        from_tree(SceneCfg, tree, "scene")


def test_the_nan_guard_is_a_part_of_the_simulation_settings():
    cfg = SimCfg(nan_guard=NanGuardCfg(folder="failures", history=7))
    assert from_tree(SimCfg, to_tree(cfg)) == cfg
    assert from_tree(SimCfg, {"nan_guard": {"folder": "failures", "history": 7}}) == cfg
    assert from_tree(SimCfg, to_tree(SimCfg())).nan_guard is None
    with pytest.raises(ValueError, match=r"sim\.nan_guard\.history=0"):
        from_tree(SimCfg, {"nan_guard": {"folder": "failures", "history": 0}}, "sim")


def test_a_sensor_that_takes_one_element_refuses_several_before_anything_is_built():
    with pytest.raises(
        ValueError, match=r"against=\('a', 'b'\): a contact sensor takes one geom there"
    ):
        ContactSensor(geoms=("foot",), against=("a", "b"), against_kind="geom")  # pyright: ignore
    spec = mujoco.MjSpec()
    for name in ("left_foot", "right_foot"):
        spec.worldbody.add_body(name=name).add_geom(name=f"{name}_sole", size=[0.1, 0, 0])
    several = r"scene\.sensors\.s: '.*' matches \['left_foot.*', 'right_foot.*'\].* name of one (geom|body)"
    for sensor in (
        ContactSensor(geoms=("left_foot_sole",), against=".*_foot_sole", against_kind="geom"),
        ContactSensor(geoms=(".*_sole",), against=".*_foot"),
        ImuSensor(body=".*_foot"),
        CameraSensor(body="(left|right)_foot"),
    ):
        with pytest.raises(ValueError, match=several):
            sensor.add_to(spec, "s")
