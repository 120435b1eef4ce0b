"""Who touches whom: a stack of two boxes, a foot on a leg, and two fingers that press against each other."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.envs import ContactSensor
from ksim_rl.physics import SimCfg
from tests.scene.sensors.bench import SensorBench

GRAVITY, SQUEEZE = 10.0, 25.0
SCENE = f"""
<mujoco>
  <option timestep="0.002" gravity="0 0 {-GRAVITY}"/>
  <worldbody>
    <body name="terrain"><geom name="terrain" type="plane" size="0 0 0.01"/></body>
    <body name="lower" pos="0 0 0.1">
      <freejoint/><geom name="lower" type="box" size="0.1 0.1 0.1" mass="3"/>
    </body>
    <body name="upper" pos="0 0 0.25">
      <freejoint/><geom name="upper" type="box" size="0.05 0.05 0.05" mass="1"/>
    </body>
    <body name="leg" pos="2 0 0.3">
      <joint name="leg" type="slide" axis="0 0 1"/><geom name="leg" size="0.05" mass="1.5"/>
      <body name="shin" pos="0 0 -0.1">
        <geom name="shin" size="0.05" mass="0.3"/>
        <body name="foot" pos="0 0 -0.1"><geom name="foot" type="box" size="0.1 0.1 0.1" mass="0.2"/></body>
      </body>
    </body>
    <body name="gripper" pos="0 2 1">
      <geom name="palm" type="box" size="0.3 0.05 0.05" mass="1" pos="0 0 0.2"/>
      <body name="left" pos="-0.1 0 0">
        <joint name="left" type="slide" axis="0.6 0.8 0"/><geom name="left" size="0.1" mass="0.5"/>
      </body>
      <body name="right" pos="0.02 0.16 0">
        <joint name="right" type="slide" axis="0.6 0.8 0"/><geom name="right" size="0.1" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="left" joint="left"/><motor name="right" joint="right"/></actuator>
</mujoco>
"""
"""The fingers slide along one line (0.6, 0.8, 0), and begin where they touch."""
FINGERS = torch.tensor([0.6, 0.8, 0.0])
SENSORS = {
    "ground": ContactSensor(bodies=("upper", "lower")),
    "pair": ContactSensor(bodies=("upper",), against="lower"),
    "by_geom": ContactSensor(geoms=("lower",), against="upper", against_kind="geom"),
    "anything": ContactSensor(bodies=("lower",), against=None),
    "limb": ContactSensor(subtrees=("leg",)),
    "joints_of_limb": ContactSensor(bodies=("leg", "shin", "foot")),
    "limb_as_other": ContactSensor(geoms=("terrain",), against="leg", against_kind="subtree"),
    "self": ContactSensor(
        subtrees=("gripper",),
        against="gripper",
        against_kind="subtree",
        reduce="strongest",
        every_substep=True,
    ),
    "fingers": ContactSensor(bodies=("left",), against="right", reduce="strongest"),
    "by_pattern": ContactSensor(geoms=("(lo|up).*er",)),
}


@pytest.fixture(scope="module", params=[False, True], ids=["mujoco_warp", "one_kernel"])
def settled(request):
    bench = SensorBench(SCENE, 2, SENSORS, sim=SimCfg(one_kernel_dynamics=request.param))
    assert (bench.world._substeps.stages.contacts is not None) == request.param
    # World 0 squeezes its fingers together, world 1 pulls them apart.
    bench.world.ctrl_EL.copy_(torch.tensor([[SQUEEZE, -SQUEEZE], [-1.0, 1.0]]))
    for _ in range(50):
        bench.step()
    return bench


def force_z(bench, name):
    return bench.view.contact(name).force_EN3[0, :, 2]


@pytest.mark.parametrize(
    ("name", "weights"),
    [
        ("ground", [0.0, -4.0]),  # the lower box carries both
        ("pair", [-1.0]),
        ("by_geom", [1.0]),  # the lower box holds the upper one up
        ("anything", [-3.0]),  # its net force on the others is its own weight
        ("limb", [-2.0]),
        ("joints_of_limb", [0.0, 0.0, -2.0]),
        ("limb_as_other", [2.0]),
        ("by_pattern", [-4.0, 0.0]),  # the model's order
    ],
)
def test_the_force_is_the_weight_that_this_pair_carries(settled, name, weights):
    expected = torch.tensor(weights) * GRAVITY
    torch.testing.assert_close(force_z(settled, name), expected, atol=0.05, rtol=0)
    found = settled.view.contact(name).found_EN[0]
    assert torch.equal(found, (expected != 0).float())


def test_forces_within_one_robot_are_those_of_its_strongest_contact(settled):
    force_E3 = settled.view.contact("self").force_EN3[:, 0]
    torch.testing.assert_close(force_E3[0].norm(), torch.tensor(SQUEEZE), atol=0.1, rtol=0)
    assert force_E3[1].eq(0.0).all(), "world 1 holds them apart"
    # Of left on right: along the line from left to right.
    torch.testing.assert_close(
        settled.view.contact("fingers").force_EN3[0, 0], SQUEEZE * FINGERS, atol=0.1, rtol=0
    )


def test_substeps_with_a_strong_self_contact_can_be_counted(settled):
    history_ESN3 = settled.view.contact("self").force_history_ESN3
    assert history_ESN3.shape == (2, 10, 1, 3)
    count_E = (history_ESN3.norm(dim=-1) > 10.0).sum((1, 2))
    assert count_E.tolist() == [10, 0]


def test_contacts_agree_with_the_c_engine(settled):
    world = settled.world
    data = mujoco.MjData(world.mj_model)
    data.qpos[:], data.qvel[:] = world.qpos_EL[0], world.qvel_EL[0]
    data.ctrl[:] = world.ctrl_EL[0]
    mujoco.mj_forward(world.mj_model, data)
    left, right = (world.mj_model.geom(name).id for name in ("left", "right"))
    (index,) = (i for i in range(data.ncon) if set(data.contact[i].geom) == {left, right})
    contact, force = data.contact[index], np.zeros(6)
    mujoco.mj_contactForce(world.mj_model, data, index, force)
    sign = 1.0 if contact.geom[0] == left else -1.0
    state = settled.view.contact("fingers")
    np.testing.assert_allclose(
        state.force_EN3[0, 0], sign * contact.frame.reshape(3, 3).T @ force[:3], atol=0.05
    )
    np.testing.assert_allclose(state.position_EN3[0, 0], contact.pos, atol=1e-4)
    # The ball of the leg's foot is a box: its point of contact is the middle of its sole.
    np.testing.assert_allclose(
        settled.view.contact("limb").position_EN3[0, 0, :2], (2.0, 0.0), atol=1e-4
    )


def test_rows_without_contact_have_no_position(settled):
    assert settled.view.contact("self").position_EN3[1].eq(0.0).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"subtrees": ("gripper",), "against": "gripper", "against_kind": "subtree"},
            r"reduce='net' with against='gripper'.*use reduce='strongest'",
        ),
        ({"bodies": ("left",), "against_kind": "site"}, r"against_kind='site'"),
        ({"bodies": ("left",), "reduce": "mean"}, r"reduce='mean'"),
    ],
)
def test_what_has_no_meaning_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        ContactSensor(**fields)


def test_unknown_others_name_the_kind_and_the_near_names():
    spec = mujoco.MjSpec.from_string(SCENE)
    sensor = ContactSensor(bodies=("left",), against="gripperr", against_kind="subtree")
    with pytest.raises(
        ValueError, match=r"scene\.sensors\.x: no body 'gripperr': did you mean 'gripper'"
    ):
        sensor.add_to(spec, "x")
