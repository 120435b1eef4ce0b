"""The kernel of contact sensors, against MuJoCo Warp's own and the C engine, on the same contacts and forces."""

import dataclasses
import itertools
from typing import Literal

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, prepare_spec
from ksim_rl.physics.sensors.contact_sensors import NET, STRONGEST, read_by_us
from tests.physics import row_models

OBJECT = mujoco.mjtObj
ELEMENTS = ((OBJECT.mjOBJ_GEOM, "box"), (OBJECT.mjOBJ_GEOM, "floor"), (OBJECT.mjOBJ_BODY, "hand"))
TREES = ((OBJECT.mjOBJ_XBODY, "trunk"), (OBJECT.mjOBJ_XBODY, "arm"))
OTHERS = (
    None,
    (OBJECT.mjOBJ_GEOM, "floor"),
    (OBJECT.mjOBJ_BODY, "world"),
    (OBJECT.mjOBJ_XBODY, "trunk"),
)
# What only MJCF of users has.
FOREIGN = (
    (NET[0], 1, 1),
    (*STRONGEST[:2], 3),
    (STRONGEST[0], NET[1], 1),
    (511, *STRONGEST[1:]),
)
ENVS = 4


def model(cone: str, foreign: tuple[tuple[int, ...], ...] = FOREIGN) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(row_models.XML)
    spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}")
    prepare_spec(spec, ())
    for own, other, layout in itertools.product(
        (*ELEMENTS, *TREES), OTHERS, (NET, STRONGEST, *foreign)
    ):
        sensor = spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=own[0], objname=own[1], intprm=[*layout]
        )
        if other is not None:
            sensor.reftype, sensor.refname = other
    return spec.compile()


def stepped(cone: str, *, one_kernel: bool = True) -> World:
    """Return worlds after one step from states in which they touch, the last one in the air."""
    sim = SimCfg(njmax=120, nconmax=40, one_kernel_dynamics=one_kernel)
    world = World(model(cone), num_envs=ENVS, sim=sim)
    place(world)
    world.step()
    return world


def place(world: World) -> None:
    rng = np.random.default_rng(0)
    qpos = world.qpos_EL.numpy()
    qpos[:, 2] -= 0.03
    qpos += 0.05 * rng.standard_normal(qpos.shape).astype(np.float32)
    qpos[-1, 2] += 3.0
    world.qvel_EL.numpy()[:] = 0.5 * rng.standard_normal(world.qvel_EL.shape)


def columns(mj_model: mujoco.MjModel, *, ours: bool) -> np.ndarray:
    read, (contact,) = (
        read_by_us(mj_model)[0],
        (mj_model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT).nonzero(),
    )
    spans = zip(mj_model.sensor_adr[contact], mj_model.sensor_dim[contact], strict=True)
    return np.concatenate(
        [
            np.arange(adr, adr + dim)
            for sensor, (adr, dim) in zip(contact, spans, strict=True)
            if (sensor in read) == ours
        ]
    )


def test_substeps_of_which_nothing_else_is_read_write_no_poses():
    seen: dict[Literal["contacts", "every"], list[tuple[torch.Tensor, ...]]] = {
        "contacts": [],
        "every": [],
    }
    sim = SimCfg(njmax=120, nconmax=40, one_kernel_dynamics=True)
    for which, moments in seen.items():
        world = World(model("pyramidal", ()), num_envs=ENVS, sim=sim)
        place(world)
        world.last_substep("xmat").fill_(7.0)

        def note(world: World = world, moments: list[tuple[torch.Tensor, ...]] = moments) -> None:
            moments.append(
                tuple(world.last_substep(name).clone() for name in ("xmat", "qpos", "sensordata"))
            )

        world.step(3, after=[note], sensors=which)
    own = columns(world.mj_model, ours=True)
    for contacts, every in zip(seen["contacts"], seen["every"], strict=True):
        assert torch.equal(contacts[1], every[1])
        assert torch.equal(contacts[2][:, own], every[2][:, own]) and contacts[2][:, own].any()
    unwritten = [bool((moment[0] == 7.0).all()) for moment in seen["contacts"]]
    assert unwritten == [True, True, False] and torch.equal(
        seen["contacts"][2][0], seen["every"][2][0]
    )


@pytest.fixture(scope="module", params=["pyramidal", "elliptic"])
def world(request: pytest.FixtureRequest) -> World:
    return stepped(request.param)


def share_that_agrees(
    mj_model: mujoco.MjModel, read: np.ndarray, expected: np.ndarray, *, tolerance: float
) -> float:
    """Return the share of our sensors whose values are the same; the number of contacts and the size of the force are.

    The others read another contact that is as strong: rounding decides, or the order of what exerts no force.
    """
    agreeing, scale = [], max(1.0, float(np.abs(expected[columns(mj_model, ours=True)]).max()))
    for sensor in read_by_us(mj_model)[0]:
        at, dim = mj_model.sensor_adr[sensor], mj_model.sensor_dim[sensor]
        own, other = read[at : at + dim], expected[at : at + dim]
        assert own[0] == other[0]
        size, other_size = (np.linalg.norm(values[1:4]) for values in (own, other))
        assert size == pytest.approx(other_size, rel=tolerance, abs=tolerance * scale)
        force_agrees = np.allclose(own[1:4], other[1:4], rtol=tolerance, atol=tolerance * scale)
        agreeing.append(force_agrees and np.allclose(own[4:], other[4:], atol=2.0 * tolerance))
    return float(np.mean(agreeing))


def test_values_are_those_of_mujoco_warp(world: World):
    ours, theirs = (columns(world.mj_model, ours=ours) for ours in (True, False))
    assert len(read_by_us(world.mj_model)[0]) == 40
    read = world.sensordata_EL.numpy().copy()
    assert (read[:-1, ours] != 0.0).mean() > 0.2 and (read[:-1, theirs] != 0.0).mean() > 0.2
    with wp.ScopedDevice("cpu"):
        world.warp_data_E.sensordata.zero_()
        # Ours would read them after it.
        without_ours = dataclasses.replace(world.warp_model, callback=mjw.Callback())
        mjw.sensor_acc(without_ours, world.warp_data_E)
    expected = world.sensordata_EL.numpy().copy()
    world.sensordata_EL.numpy()[:] = read
    # Of contacts that are as strong or as near, it may read others.
    scale = np.maximum(1.0, np.abs(expected[:, theirs]).max())
    assert (np.abs(read[:, theirs] - expected[:, theirs]) < 1e-5 * scale).mean() > 0.95
    shares = [
        share_that_agrees(world.mj_model, *pair, tolerance=2e-6)
        for pair in zip(read, expected, strict=True)
    ]
    assert np.mean(shares) > 0.95, shares


def test_values_are_those_of_the_c_engine(world: World):
    start, shares = World(world.mj_model, num_envs=ENVS, sim=world.sim), []
    place(start)
    for row in range(ENVS):
        mj_data = mujoco.MjData(world.mj_model)
        mj_data.qpos[:], mj_data.qvel[:] = start.qpos_EL[row].numpy(), start.qvel_EL[row].numpy()
        mujoco.mj_forward(world.mj_model, mj_data)
        read = world.sensordata_EL[row].numpy()
        shares.append(share_that_agrees(world.mj_model, read, mj_data.sensordata, tolerance=1e-3))
    assert np.mean(shares) > 0.95, shares


def test_bits_do_not_depend_on_places_in_the_pool(world: World):
    contacts = world._substeps.stages.contacts
    assert contacts is not None
    read = world.sensordata_EL.numpy().copy()
    with wp.ScopedDevice("cpu"):
        contacts.rne_postconstraint(world.warp_model)
    forces = world.last_substep("cfrc_ext").numpy().copy()
    for seed in range(3):
        row_models.permute_pool(world, seed)
        world.sensordata_EL.zero_()
        with wp.ScopedDevice("cpu"):
            contacts.list()
            contacts.read_sensors()
            contacts.rne_postconstraint(world.warp_model)
        np.testing.assert_array_equal(world.last_substep("cfrc_ext").numpy(), forces)
        ours = columns(world.mj_model, ours=True)
        np.testing.assert_array_equal(world.sensordata_EL.numpy()[:, ours], read[:, ours])


def test_of_equally_strong_contacts_the_first_in_the_order_of_the_c_engine_counts():
    """A ball between two walls that press alike: MuJoCo Warp's choice would depend on its sort."""
    spec = mujoco.MjSpec.from_string(
        """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody>
        <geom name="left" type="box" size="0.1 1 1" pos="-0.19 0 0"/>
        <geom name="right" type="box" size="0.1 1 1" pos="0.19 0 0"/>
        <body name="ball"><freejoint/><geom name="ball" size="0.1"/></body></worldbody></mujoco>"""
    )
    for layout in (NET, STRONGEST):
        spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=OBJECT.mjOBJ_GEOM,
            objname="ball",
            intprm=[*layout],
        )
    prepare_spec(spec, ())
    world = World(
        spec.compile(), num_envs=2, sim=SimCfg(njmax=20, nconmax=8, one_kernel_dynamics=True)
    )
    mj_data = mujoco.MjData(world.mj_model)
    mujoco.mj_forward(world.mj_model, mj_data)
    world.step()
    force, other = mj_data.efc_force.reshape(2, -1).sum(1)
    assert force == pytest.approx(other, abs=1e-9) and force > 1.0
    assert mj_data.sensordata[11] == pytest.approx(-0.095)  # the left wall's
    for row in world.sensordata_EL.numpy():
        np.testing.assert_allclose(row, mj_data.sensordata, rtol=1e-3, atol=2e-3)


def test_forces_on_bodies_are_those_of_mujoco_warp(world: World):
    contacts, found = world._substeps.stages.contacts, {}
    assert contacts is not None
    world.xfrc_applied_EL[:, 1, :] = torch.arange(6.0)
    with wp.ScopedDevice("cpu"):
        for name, launch in (("ours", contacts.rne_postconstraint), ("theirs", theirs_of(world))):
            launch(world.warp_model)
            found[name] = {
                part: world.last_substep(part).numpy().copy()
                for part in ("cfrc_ext", "cfrc_int", "cacc")
            }
    for part, expected in found["theirs"].items():
        scale = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(found["ours"][part], expected, rtol=1e-5, atol=2e-6 * scale)
    assert np.abs(found["ours"]["cfrc_ext"]).max() > 10.0


def theirs_of(world: World):
    return lambda warp_model: mjw.rne_postconstraint(warp_model, world.warp_data_E)


@pytest.mark.parametrize("others", [(), (OBJECT.mjOBJ_BODY,)])
def test_accelerometers_are_those_of_mujoco_warp_which_computes_forces_of_bodies_for_other_sensors_only(
    others,
):
    spec = mujoco.MjSpec.from_string(row_models.XML)
    for body in ("trunk", "arm", "hand"):
        site = spec.body(body).add_site(
            name=f"{body}_imu", pos=[0.03, -0.02, 0.1], quat=[0.5, -0.5, 0.1, 0.7]
        )
        kind = mujoco.mjtSensor.mjSENS_ACCELEROMETER
        spec.add_sensor(type=kind, objtype=OBJECT.mjOBJ_SITE, objname=site.name)
    for kind in others:
        spec.add_sensor(type=mujoco.mjtSensor.mjSENS_FRAMELINACC, objtype=kind, objname="trunk")
    prepare_spec(spec, ())
    model, found = spec.compile(), []
    for theirs in (False, True):
        world = World(
            model, num_envs=ENVS, sim=SimCfg(njmax=120, nconmax=40, one_kernel_dynamics=True)
        )
        place(world)
        world.qvel_EL.mul_(4.0)
        models, all_of_them = world._substeps._models, world.warp_model.sensor_acc_adr
        assert models["kept"].sensor_rne_postconstraint == bool(others)
        if theirs:
            whole = {"sensor_acc_adr": all_of_them, "sensor_rne_postconstraint": True}
            models["kept"] = dataclasses.replace(models["kept"], **whole)
        world.step()
        found.append(world.sensordata_EL.clone())
    assert found[0].abs().amax() > 20.0
    assert torch.equal(*found)


def test_forces_on_bodies_are_computed_from_when_on_they_are_read():
    world = stepped("elliptic")
    assert not world.last_substep("cfrc_ext").any()
    forces = world.view("cfrc_ext")
    world.step()
    assert forces.abs().amax() > 10.0


def test_without_the_kernel_of_the_dynamics_mujoco_warp_reads_all():
    assert stepped("elliptic", one_kernel=False)._substeps.stages.contacts is None
