"""Every field that may differ between worlds has in its world the effect that it has in the C engine."""

import copy

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World
from ksim_rl.physics.fields import ALL, const_groups, derived_fields, write_fields
from ksim_rl.physics.upstream import per_world_fields
from tests.physics.field_models import (
    FIELDS,
    MODELS,
    OF_OTHER_TESTS,
    OF_PICTURES,
    changed,
    compiled,
)

STEPS = 4
# Of the state reached, and of the last substep.
_POSES = (
    "qpos qvel act xpos xquat xipos geom_xpos geom_xmat site_xpos site_xmat subtree_com sensordata"
)
_SEEN = "cam_xpos cam_xmat light_xpos light_xdir"
_FORCES = "qacc actuator_force qfrc_passive qfrc_actuator qfrc_constraint"
REACHED, FORCES = f"{_POSES} {_SEEN}".split(), _FORCES.split()
TOLERANCES = {"qacc": 2e-2, "qfrc_constraint": 1e-2}
REFUSED = ("actuator_history", "actuator_historyadr", "sensor_history", "sensor_historyadr")
OURS = SimCfg(one_kernel_dynamics=True, njmax=120, nconmax=40)
THEIRS = SimCfg(one_kernel_dynamics=False, njmax=120, nconmax=40)
NO_KERNEL = SimCfg(one_kernel_solver=False, njmax=120, nconmax=40)


def start(mj_model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """A state with all that moves in motion, and controls that some actuators cut off."""
    rng = np.random.default_rng(0)
    qpos = mj_model.qpos0.copy()
    mujoco.mj_integratePos(mj_model, qpos, 0.005 * rng.normal(size=mj_model.nv), 1.0)
    mj_data = mujoco.MjData(mj_model)
    return {
        "qpos": qpos,
        "qvel": 0.3 * rng.normal(size=mj_model.nv),
        "ctrl": rng.uniform(0.25, 0.5, size=mj_model.nu),
        "act": rng.uniform(0.0, 0.3, size=mj_model.na),
        "mocap_pos": mj_data.mocap_pos + 0.1,
        "mocap_quat": mj_data.mocap_quat,
    }


def in_c(mj_model: mujoco.MjModel, state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What the C engine reaches from a state, and the poses and sensors of what it reaches."""
    mj_data = mujoco.MjData(mj_model)
    for name, values in state.items():
        getattr(mj_data, name)[:] = values.astype(np.float32)
    mujoco.mj_step(mj_model, mj_data, STEPS)
    found = {name: np.array(getattr(mj_data, name)) for name in FORCES}
    contacts = np.array(mj_data.ncon)
    delayed = mj_model.sensor_history.any(-1).repeat(mj_model.sensor_dim)
    sensordata = mj_data.sensordata.copy()
    mujoco.mj_fwdPosition(mj_model, mj_data)
    mujoco.mj_sensorPos(mj_model, mj_data)
    mujoco.mj_fwdVelocity(mj_model, mj_data)
    mujoco.mj_sensorVel(mj_model, mj_data)
    mujoco.mj_camlight(mj_model, mj_data)
    found |= {name: np.array(getattr(mj_data, name)) for name in REACHED}
    found["ncon"] = contacts
    found["sensordata"] = np.where(delayed, sensordata, found["sensordata"])
    return found


def stepped(model: str, sim: SimCfg, fields: tuple[str, ...]) -> World:
    """Worlds that differ in one of `fields` each, and in nothing else, after a few substeps."""
    mj_model = compiled(model)
    world = World(mj_model, num_envs=len(fields), sim=sim, per_world_fields=fields)
    world.view("cam_xpos")
    # What a set_const derives in all worlds alike is written after it.
    for row, name in sorted(enumerate(fields), key=lambda item: item[1] in derived_fields(ALL)):
        field = world.field(name)
        field[row] = torch.from_numpy(changed(mj_model, name)).reshape(field[row].shape)
        mask_E = torch.zeros(len(fields), dtype=torch.bool)
        mask_E[row] = True
        world.set_const((name,), mask_E)
    world.reset(torch.ones(len(fields), dtype=torch.bool))
    for name, values in start(mj_model).items():
        world.view(name).copy_(torch.from_numpy(values).expand_as(world.view(name)))
    world.step(STEPS)
    world.refresh()
    return world


def differences(world: World, row: int, expected: dict[str, np.ndarray]) -> list[str]:
    """What of a world is not as expected."""
    found, num_contacts = [], int(world.last_substep("nacon"))
    contacts = (world.last_substep("contact.worldid")[:num_contacts] == row).sum()
    for name, wanted in expected.items():
        actual = contacts if name == "ncon" else world.last_substep(name)[row]
        actual = actual.numpy().reshape(wanted.shape)
        error = np.abs(actual - wanted).max(initial=0.0) / (1.0 + np.abs(wanted).max(initial=0.0))
        if not error < TOLERANCES.get(name, 2e-3):
            found.append(f"{name} by {error:.2g}")
    return found


@pytest.mark.parametrize(
    ("model", "sim"),
    [
        *((model, OURS) for model in ("plain", "fluid", "viscous", "sticky")),
        ("plain", THEIRS),
        pytest.param("fluid", THEIRS, marks=pytest.mark.full),
        pytest.param("viscous", THEIRS, marks=pytest.mark.full),
        ("sticky", THEIRS),
        ("rich", THEIRS),
        ("rich", NO_KERNEL),
    ],
    ids=lambda value: value if isinstance(value, str) else "ours" if value is OURS else "theirs",
)
def test_each_field_has_its_effect(model: str, sim: SimCfg):
    fields, faults = FIELDS[model], []
    world = stepped(model, sim, fields)
    state, plain = start(world.mj_model), in_c(compiled(model), start(world.mj_model))
    for row, name in enumerate(fields):
        mj_model = compiled(model)
        write_fields(mj_model, {name: world.field(name)[row].numpy()})
        expected = in_c(mj_model, state)
        effect = max(
            np.abs(values - plain[key]).max(initial=0.0) for key, values in expected.items()
        )
        if effect < 1e-4:
            faults.append(f"{name} has no effect in C, so that it says nothing")
        faults += [f"{name}: {what}" for what in differences(world, row, expected)]
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    ("model", "sim"), [("plain", OURS), ("plain", THEIRS), ("rich", THEIRS), ("sticky", OURS)]
)
def test_each_world_has_a_gravity_of_its_own(model: str, sim: SimCfg):
    mj_model = compiled(model)
    world = World(mj_model, num_envs=2, sim=sim)
    world.view("cam_xpos")
    world.field("gravity")[1] = torch.tensor([1.0, -2.0, -5.0])
    for name, values in start(mj_model).items():
        world.view(name).copy_(torch.from_numpy(values).expand_as(world.view(name)))
    world.step(STEPS)
    world.refresh()
    for row in range(2):
        write_fields(mj_model, {"gravity": world.field("gravity")[row].numpy()})
        assert not differences(world, row, in_c(mj_model, start(mj_model)))


def test_no_field_is_left_out():
    tested = {name for fields in FIELDS.values() for name in fields}
    assert {*tested, *OF_PICTURES, *OF_OTHER_TESTS, *REFUSED} == set(per_world_fields())


# What follows from fields in C, and is equal in all worlds: bounds of volume hierarchies, frames that are equal to
# others, statistics and lengths of sleep, the inertia of simple bodies, and what is switched on where fields differ.
_ONLY_IN_C = {
    *(
        "bvh_aabb",
        "body_margin",
        "body_sameframe",
        "geom_sameframe",
        "site_sameframe",
        "dof_length",
        "dof_M0",
    ),
    *("actuator_length0", "flg_gravcomp", "ngravcomp", "flg_adhesion", "flg_surfacevel"),
    *("jnt_actuatorid", "tendon_actuatorid"),
}


def numbers(mj_model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """All numbers of a model."""
    values = {name: getattr(mj_model, name) for name in dir(mj_model) if not name.startswith("_")}
    return {
        name: np.array(value, dtype=float)
        for name, value in values.items()
        if isinstance(value, (int, float))
        or (isinstance(value, np.ndarray) and value.dtype.kind in "bif")
    }


@pytest.mark.parametrize("model", MODELS)
def test_all_that_c_derives_from_a_field_is_derived(model: str):
    for name in FIELDS[model]:
        mj_model = compiled(model)
        mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))
        before, other = numbers(mj_model), copy.copy(mj_model)
        getattr(other, name)[:] = changed(mj_model, name).reshape(getattr(other, name).shape)
        mujoco.mj_setConst(other, mujoco.MjData(other))
        after = numbers(other)
        if model == "viscous":
            before.pop("geom_fluid")  # whose masses are none without density
        follows = {
            key
            for key, values in before.items()
            if not np.allclose(values, after[key], rtol=1e-9, atol=1e-12)
        }
        ours = {name, *derived_fields(const_groups((name,), mj_model))}
        assert follows <= ours | _ONLY_IN_C, f"{name}: {follows - ours - _ONLY_IN_C}"


@pytest.mark.parametrize(
    "name", ["body_gravcomp", "geom_margin", "geom_gap", "geom_adhesion", "geom_surfacevel"]
)
@pytest.mark.parametrize("sim", [OURS, THEIRS], ids=("ours", "theirs"))
def test_one_world_alone_has_fields_of_its_own(sim: SimCfg, name: str):
    """Its arrays are no longer than those that worlds share, and begin without an effect."""
    world = stepped("sticky", sim, (name,))
    mj_model = compiled("sticky")
    write_fields(mj_model, {name: world.field(name)[0].numpy()})
    assert not differences(world, 0, in_c(mj_model, start(mj_model)))


def test_fields_without_effect_are_refused():
    for name in REFUSED:
        with pytest.raises(
            ValueError, match=f"per_world_fields has '{name}', which says where past values lie"
        ):
            World(compiled("rich"), num_envs=2, per_world_fields=(name,))
    for name in (
        "jnt_springyield",
        "tendon_springyield",
        "actuator_delay",
        "sensor_delay",
        "sensor_interval",
    ):
        with pytest.raises(
            ValueError, match=f"per_world_fields has '{name}', but no .* in the model"
        ):
            World(compiled("plain"), num_envs=2, per_world_fields=(name,))
    with pytest.raises(ValueError, match="'geom_size', but geom 'hull' moves the fluid around it"):
        World(compiled("fluid"), num_envs=2, per_world_fields=("geom_size",))
    with pytest.raises(ValueError, match="'jnt_axis', but body 'puck' is compiled as simple"):
        World(
            mujoco.MjModel.from_xml_string(MODELS["plain"]),
            num_envs=2,
            per_world_fields=("jnt_axis",),
        )
