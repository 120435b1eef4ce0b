import copy

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World
from tests.physics.models import cartpole, quadruped, standing_quadrupeds

SIM = SimCfg(njmax=80, nconmax=40)


def with_constants(
    mj_model: mujoco.MjModel, row: int, world: World, fields: tuple[str, ...]
) -> mujoco.MjModel:
    """The C engine's model with the fields of one world, and all that follows from them."""
    changed = copy.copy(mj_model)
    for field in fields:
        getattr(changed, field)[:] = world.field(field)[row].numpy()
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
    world = standing_quadrupeds(per_world_fields=("body_mass",))
    before = {name: world.view(name).clone() for name in ("qpos", "qvel", "sensordata", "xpos", "ctrl")}
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
    with pytest.raises(ValueError, match="'body_mass' is shared by all worlds: add it to per_world_fields"):
        world.field("body_mass")
