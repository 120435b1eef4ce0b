import copy
import warnings

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model, prepare_spec
from ksim_rl.physics.constants.least_weights import SHARE
from ksim_rl.physics.field_effects import as_if_drawn
from ksim_rl.physics.fields import const_groups
from tests.physics.models import cartpole, quadruped, standing_quadrupeds

SIM = SimCfg(njmax=80, nconmax=40)

EVERY_JOINT = """
<mujoco>
  <worldbody>
    <light name="sun" pos="0 0 3"/>
    <camera name="outside" mode="trackcom" pos="0 -2 1"/>
    <body name="base" pos="0.1 0 1" quat="1 .2 0 .1">
      <freejoint/>
      <geom type="box" size=".1 .2 .3" mass="2" pos=".1 0 0"/>
      <camera name="inside" pos=".1 .2 0" mode="trackcom"/>
      <body name="arm" pos="0 .2 0">
        <joint name="ball" type="ball" pos="0 -.05 0"/>
        <geom type="capsule" size=".05 .2" mass=".7" pos=".1 .2 0"/>
        <body name="hand" pos=".3 0 0" quat="1 0 .5 0">
          <joint name="slide" type="slide" axis="1 1 0"/>
          <joint name="hinge" axis="0 1 1" pos=".1 0 0" armature=".02"/>
          <geom type="sphere" size=".1" mass=".3" pos="0 0 .1"/>
          <body name="finger" pos="0 .1 0"><geom size=".04" mass=".2"/></body>
        </body>
      </body>
    </body>
    <body name="wheel" pos="1 0 0"><joint name="axle"/><geom size=".1" mass="1" pos="0 .1 0"/></body>
  </worldbody>
  TENDON
  <actuator>
    <position joint="slide" gear="3" kp="2"/>
    <motor joint="hinge" gear="-2"/>
  </actuator>
</mujoco>
"""
TENDON = """<tendon><fixed name="pull" limited="true" range="-1 1"><joint joint="slide" coef="1"/>
  <joint joint="axle" coef="-2"/></fixed></tendon>"""
CONSTANTS = (
    *(
        "body_subtreemass",
        "dof_invweight0",
        "body_invweight0",
        "actuator_acc0",
        "tendon_length0",
        "tendon_invweight0",
    ),
    *("cam_pos0", "cam_poscom0", "cam_mat0", "light_pos0", "light_poscom0", "light_dir0"),
)
INERTIAL = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "dof_armature")
KINEMATIC = ("body_mass", "body_pos", "body_quat", "jnt_pos", "jnt_axis", "actuator_gear")


def with_constants(
    mj_model: mujoco.MjModel, row: int, world: World, fields: tuple[str, ...]
) -> mujoco.MjModel:
    """The C engine's model with the fields of one world, and all that follows from them."""
    changed = copy.copy(mj_model)
    for field in fields:
        values = getattr(changed, field)
        values[:] = world.field(field)[row].numpy().reshape(values.shape)
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    return changed


def test_derived_constants_follow_the_field_in_each_world():
    fields = ("body_mass", "dof_armature")
    world = World(quadruped(), num_envs=3, sim=SIM, per_world_fields=fields)
    world.field("body_mass")[1] *= 2.0
    world.field("dof_armature")[2] += 0.05
    world.set_const(fields)
    for row in range(3):
        expected = with_constants(quadruped(), row, world, fields)
        for derived in ("body_subtreemass", "dof_invweight0", "body_invweight0", "actuator_acc0"):
            actual = world.field(derived)[row].numpy()
            np.testing.assert_allclose(
                actual, getattr(expected, derived), rtol=2e-4, atol=1e-6, err_msg=derived
            )


def test_changed_fields_change_the_motion_as_in_the_c_engine():
    world = World(cartpole(), num_envs=2, per_world_fields=("dof_damping", "body_mass"))
    world.field("dof_damping")[1, 0] = 2.0
    world.field("body_mass")[1, 1] = 3.0
    world.set_const(("body_mass",))
    world.ctrl_EL.fill_(0.5)
    world.qpos_EL[:, 1] = 0.2
    world.step(50)
    for row in range(2):
        changed = with_constants(cartpole(), row, world, ("dof_damping", "body_mass"))
        mj_data = mujoco.MjData(changed)
        mj_data.ctrl[:], mj_data.qpos[1] = 0.5, 0.2
        mujoco.mj_step(changed, mj_data, 50)
        np.testing.assert_allclose(world.qpos_EL[row], mj_data.qpos, rtol=1e-4, atol=1e-5)
    assert abs(world.qpos_EL[0, 0] - world.qpos_EL[1, 0]) > 0.05


def test_set_const_leaves_the_state_alone():
    world = standing_quadrupeds(per_world_fields=("body_mass", "geom_friction"))
    before = {
        name: world.view(name).clone() for name in ("qpos", "qvel", "sensordata", "xpos", "ctrl")
    }
    world.set_const(("body_mass", "geom_friction"))
    for name, tensor in before.items():
        assert torch.equal(world.view(name), tensor), name


def test_friction_and_gravity_need_no_constants():
    world = standing_quadrupeds(per_world_fields=("geom_friction", "gravity"))
    assert world.field("geom_friction").shape == (4, world.mj_model.ngeom, 3)
    assert world.field("gravity") is world.gravity_EL
    world.field("geom_friction")[0] = 0.01
    world.set_const(("geom_friction", "gravity"))


def test_unknown_and_shared_fields_are_named():
    with pytest.raises(
        ValueError, match="unknown per-world model field 'body_mas': did you mean 'body_mass'"
    ):
        World(cartpole(), num_envs=2, per_world_fields=("body_mas",))
    with pytest.raises(ValueError, match="expected a sequence of names"):
        World(cartpole(), num_envs=2, per_world_fields="body_mass")
    world = World(cartpole(), num_envs=2)
    with pytest.raises(
        ValueError, match="'body_mass' is shared by all worlds: add it to per_world_fields"
    ):
        world.field("body_mass")


def every_joint(fields: tuple[str, ...], *, tendon: str = "") -> World:
    """Three worlds with other numbers in each of the fields; the constants are the compiled model's."""
    spec = mujoco.MjSpec.from_string(EVERY_JOINT.replace("TENDON", tendon))
    prepare_spec(spec, INERTIAL)
    world = World(load_model(spec), num_envs=3, per_world_fields=fields, sim=SIM)
    generator = torch.Generator().manual_seed(0)
    for name in fields:
        field = world.field(name)
        if name.endswith(("pos", "quat", "axis")):
            field += 0.2 * torch.randn(field.shape, generator=generator)
        else:
            field *= 1.0 + torch.rand(field.shape, generator=generator)
        if name.endswith(("quat", "axis")):
            field /= field.norm(dim=-1, keepdim=True)
    return world


@pytest.mark.parametrize(
    ("fields", "tendon"),
    [(INERTIAL, ""), (KINEMATIC, ""), (INERTIAL, TENDON)],
    ids=("inertial", "kinematic", "with a tendon"),
)
def test_constants_of_masked_rows_are_those_of_the_c_engine_and_others_stay(fields, tendon):
    world = every_joint(fields, tendon=tendon)
    world.set_const(fields)
    before = {name: world.field(name).clone() for name in CONSTANTS}
    mask_E = torch.tensor([True, False, True])
    for name in fields:
        if not name.endswith(("quat", "axis")):
            world.field(name)[mask_E] *= 1.3
    world.set_const(fields, mask_E)
    for row in range(3):
        expected = with_constants(world.mj_model, row, world, fields)
        for name in CONSTANTS:
            actual = world.field(name)[row]
            if row == 1:
                assert torch.equal(actual, before[name][row]), name
                continue
            wanted = getattr(expected, name)
            np.testing.assert_allclose(
                actual.numpy().reshape(wanted.shape), wanted, rtol=2e-5, atol=1e-5, err_msg=name
            )
    assert not torch.allclose(
        world.field("dof_invweight0")[0], before["dof_invweight0"][0], rtol=0.01
    )


def test_masked_constants_equal_those_of_all_rows():
    world = every_joint(INERTIAL)
    world.set_const(INERTIAL, torch.ones(3, dtype=torch.bool))
    masked = {name: world.field(name).clone() for name in CONSTANTS}
    mjw.set_const(world.warp_model, world.warp_data_E)
    for name, values in masked.items():
        torch.testing.assert_close(values, world.field(name), rtol=5e-6, atol=1e-6)


def test_masked_set_const_leaves_the_state_alone():
    world = standing_quadrupeds(per_world_fields=("body_mass", "body_ipos"))
    before = {name: view.clone() for name, view in world.views().items()}
    world.set_const(("body_mass", "body_ipos"), torch.tensor([True, False, True, True]))
    for name, tensor in before.items():
        assert torch.equal(world.view(name), tensor), name
    with pytest.raises(ValueError, match="mask_E is torch.float32"):
        world._take_mask(torch.ones(4))


def test_moved_centres_of_mass_need_bodies_that_are_not_compiled_as_simple():
    source = '<mujoco><worldbody><body name="ball"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    with pytest.raises(ValueError, match="'body_ipos', but body 'ball' is compiled as simple"):
        World(load_model(source), num_envs=2, per_world_fields=("body_ipos",))


def test_balls_elsewhere_need_bodies_that_are_not_compiled_as_simple():
    source = (
        '<mujoco><worldbody><body name="ball"{}><joint type="ball"/><geom type="box" size=".1 .05 .03"/></body>'
        '<body pos="1 0 0"><joint/><geom size=".1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(
        ValueError,
        match="'jnt_pos', but body 'ball' is compiled as simple, turning about its centre",
    ):
        World(load_model(source.format("")), num_envs=2, per_world_fields=("jnt_pos",))
    World(load_model(source.format(' simple="false"')), num_envs=2, per_world_fields=("jnt_pos",))


@pytest.mark.parametrize("mass", (0.0, 0.1))
def test_bodies_without_mass_in_a_fluid_are_warned_of(mass: float):
    source = (
        '<mujoco><option density="100"/><worldbody><body><joint/><geom size=".1"/>'
        f'<body name="fin" pos="1 0 0"><geom size=".1" mass="{mass}"/></body></body></worldbody></mujoco>'
    )
    mj_model = load_model(source)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        World(mj_model, num_envs=1, per_world_fields=("body_mass",))
    told = [
        str(warning.message)
        for warning in caught
        if "body 'fin', which is in a fluid" in str(warning.message)
    ]
    assert len(told) == (mass == 0.0)


def test_room_for_dry_friction_that_the_model_does_not_have():
    spec = mujoco.MjSpec.from_string(EVERY_JOINT.replace("TENDON", ""))
    plain = World(load_model(spec), num_envs=1)
    rubbing = World(load_model(spec), num_envs=1, per_world_fields=("dof_frictionloss",))
    rubbing.field("dof_frictionloss")[:] = 1.0
    rubbing.step(1)
    assert rubbing.njmax >= plain.njmax + 3
    assert not rubbing.overflow_report().messages


def test_set_const_of_what_cannot_have_changed_is_refused():
    world = World(quadruped(), num_envs=2, per_world_fields=("geom_friction",))
    for mask_E in (None, torch.tensor([True, False])):
        with pytest.raises(
            ValueError, match="'body_mass' is shared by all worlds: add it to per_world_fields"
        ):
            world.set_const(("body_mass",), mask_E)
        with pytest.raises(ValueError, match="unknown per-world model field 'body_mas'"):
            world.set_const(("body_mas",), mask_E)


SLIDES = """<mujoco><worldbody>
  <body name="cart"><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
    <body name="lift" pos=".3 0 0"><joint name="z" type="slide" axis="0 1 .5"/><geom size=".1" mass="2"/>
      <body name="bolted" pos="0 .1 0"><geom size=".05" mass=".3"/></body>
      <body name="arm"><joint name="turn" axis="0 1 0"/><geom size=".1" pos=".1 0 0" mass="1"/></body></body></body>
  <body name="wheel" pos="0 2 1"><joint name="axle" axis="1 0 0"/><geom size=".1" mass="1"/></body>
  <body name="puck" pos="0 4 1"><joint name="px" type="slide" axis="1 0 0" armature=".5"/>
    <joint name="py" type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body>
  <body name="wall" pos="0 3 1"><geom size=".1" mass="1"/></body>
</worldbody>TENDON</mujoco>"""
STRAP = '<tendon><fixed name="strap"><joint joint="x" coef="1"/><joint joint="z" coef="-1"/></fixed></tendon>'


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("tendon", ["", STRAP, STRAP.replace("<fixed", '<fixed armature=".2"')])
def test_bodies_that_only_slide_or_only_turn_weigh_as_in_the_c_engine(tendon, masked):
    """C leaves 0 where a body cannot move in that way, and forgets the armature of slides of a simple body."""
    fields = ("body_mass", "dof_armature")
    world = World(load_model(SLIDES.replace("TENDON", tendon)), num_envs=2, per_world_fields=fields)
    world.field("body_mass")[1] *= 2.0
    world.field("dof_armature")[1] += 0.4
    world.set_const(fields, torch.tensor([False, True]) if masked else None)
    for row in range(2):
        expected = with_constants(world.mj_model, row, world, fields)
        weights = expected.body_invweight0
        for name in ("cart", "lift", "bolted", "puck"):
            assert (
                weights[world.mj_model.body(name).id, 0]
                > 0.0
                == weights[world.mj_model.body(name).id, 1]
            )
        wheel = world.mj_model.body("wheel").id
        assert not weights[wheel, 0]
        # Without any weight, contacts with what is fixed would exert rounding errors.
        weights[wheel, 0] = SHARE / world.mj_model.body_mass[wheel]
        for name in ("body_invweight0", "dof_invweight0"):
            np.testing.assert_allclose(
                world.field(name)[row], getattr(expected, name), rtol=2e-5, atol=1e-6, err_msg=name
            )


def test_rows_are_recomputed_in_one_launch(monkeypatch):
    """At resets few rows need it, so that launches cost more than the work."""
    world, launched = every_joint(INERTIAL), []
    monkeypatch.setattr(wp, "launch", lambda kernel, **_: launched.append(kernel.func.__name__))
    world._masked_constants.launch(const_groups(INERTIAL, world.mj_model))
    assert launched == ["constants_at_qpos0"]


def test_a_field_gets_its_numbers_back_where_building_kernels_fails():
    world = World(quadruped(), num_envs=2, sim=SIM, per_world_fields=["geom_margin"])
    own = world.warp_model.geom_margin.numpy().copy()
    with pytest.raises(RuntimeError), as_if_drawn(world.warp_model, ["geom_margin"]):
        assert (world.warp_model.geom_margin.numpy() != own).all()
        raise RuntimeError
    assert (world.warp_model.geom_margin.numpy() == own).all()
