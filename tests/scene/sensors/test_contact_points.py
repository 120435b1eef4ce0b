"""Contacts one by one, against the contacts of the C engine with forces from `mj_contactForce`."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.scene.sensors import ContactPoints, ContactSensor
from tests.scene.sensors.bench import SensorBench

SCENE = """
<mujoco>
  <option timestep="0.002" cone="elliptic"/>
  <default><geom condim="6" friction="0.8 0.02 0.01"/></default>
  <worldbody>
    <body name="terrain"><geom name="terrain" type="plane" size="0 0 0.01"/></body>
    <body name="wall" pos="0.35 0 0.2"><geom name="wall" type="box" size="0.05 0.5 0.3"/></body>
    <body name="plank" pos="0 0 0.048">
      <freejoint/>
      <geom name="left" type="sphere" size="0.05" pos="-0.25 0.02 0" mass="2"/>
      <geom name="right" type="sphere" size="0.05" pos="0.252 0 0" mass="1"/>
      <geom name="bar" type="box" size="0.2 0.02 0.02" mass="0.5"/>
    </body>
  </worldbody>
</mujoco>
"""
PARTNERS = ("terrain", "wall")


def bench_of(**fields):
    sensor = ContactPoints(bodies=("plank",), against=PARTNERS, **fields)
    bench = SensorBench(SCENE, 2, {"points": sensor})
    # The second row stands 0.1 m away from the wall.
    pose = torch.tensor(
        [[0.0, 0.0, 0.048, 1.0, 0.0, 0.0, 0.0], [-0.1, 0.0, 0.048, 1.0, 0.0, 0.0, 0.0]]
    )
    bench.place(
        qpos=pose,
        qvel=torch.tensor([[0.5, 0.3, -0.2, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]]),
    )
    return bench


def contacts_of_c(bench, row, substeps):
    """Return by substep and partner the contacts of the C engine: force, torque, distance, position, normal."""
    model = bench.world.mj_model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (
        bench.world.qpos_EL[row].double(),
        bench.world.qvel_EL[row].double(),
    )
    plank = model.body("plank").id
    by_substep = []
    for _ in range(substeps):
        # What the sensors of a substep see is the state that it starts from.
        mujoco.mj_forward(model, data)
        found = {name: [] for name in PARTNERS}
        for number, contact in enumerate(data.contact):
            bodies = [int(model.geom_bodyid[geom]) for geom in (contact.geom1, contact.geom2)]
            partner = model.body(next(body for body in bodies if body != plank)).name
            # Normals point from the first geom to the second; forces are of the first on the second.
            sign = 1.0 if bodies[0] == plank else -1.0
            six, axes = np.zeros(6), contact.frame.reshape(3, 3)
            mujoco.mj_contactForce(model, data, number, six)
            found[partner].append(
                (
                    sign * axes.T @ six[:3],
                    sign * axes.T @ six[3:],
                    contact.dist,
                    contact.pos.copy(),
                    sign * axes[0],
                )
            )
        by_substep.append(found)
        mujoco.mj_step(model, data)
    return by_substep


KEYS = {"strongest": lambda one: -np.linalg.norm(one[0]), "deepest": lambda one: one[2]}


@pytest.mark.parametrize("order", KEYS)
def test_contacts_are_those_of_the_c_engine_in_their_order(order):
    bench = bench_of(num_slots=3, order=order)
    expected = [contacts_of_c(bench, row, 3)[-1] for row in range(2)]
    bench.step(3)
    state = bench.view.contact_points("points")
    assert state.found_EN.shape == (2, 6) and state.force_history_ESN3.shape == (2, 1, 6, 3)
    for row in range(2):
        for place, partner in enumerate(PARTNERS):
            ordered = sorted(expected[row][partner], key=KEYS[order])
            slots = slice(3 * place, 3 * place + 3)
            assert state.found_EN[row, slots].tolist() == [1.0] * len(ordered) + [0.0] * (
                3 - len(ordered)
            )
            for slot, contact in enumerate(ordered, start=3 * place):
                for leaf, value, atol in zip(
                    (
                        state.force_EN3,
                        state.torque_EN3,
                        state.distance_EN,
                        state.position_EN3,
                        state.normal_EN3,
                    ),
                    contact,
                    (0.2, 2e-3, 1e-5, 1e-4, 1e-4),
                    strict=True,
                ):
                    np.testing.assert_allclose(leaf[row, slot], value, atol=atol, rtol=5e-3)
    # Row 0 slides along the ground and presses against the wall; row 1 stands on the ground alone.
    assert (
        len(expected[0]["terrain"]) == 2
        and len(expected[0]["wall"]) == 1
        and not expected[1]["wall"]
    )
    assert state.torque_EN3[0].norm(dim=-1).max() > 1e-3
    term = mdp.ContactReading(sensor="points", quantity="torque")
    with bench.driver.scope("observations/x"):
        assert torch.equal(term(bench.view), state.torque_EN3.flatten(1))
        assert torch.equal(
            mdp.ContactReading(sensor="points", quantity="distance")(bench.view), state.distance_EN
        )


def test_a_history_has_any_length_and_begins_with_the_episode():
    bench = bench_of(history=7)
    expected = contacts_of_c(bench, 0, 10)
    bench.step(5)
    history = bench.view.contact_points("points").force_history_ESN3.clone()
    bench.step(5)
    longer = bench.view.contact_points("points")
    for held, first, filled in ((history, 0, 5), (longer.force_history_ESN3, 3, 7)):
        assert held.shape == (2, 7, 2, 3) and (held[:, : 7 - filled] == 0.0).all()
        for substep in range(filled):
            strongest = min(expected[first + substep]["terrain"], key=KEYS["strongest"])
            place = 7 - filled + substep
            np.testing.assert_allclose(held[0, place, 0], strongest[0], atol=0.5, rtol=2e-2)
    assert torch.equal(longer.force_history_ESN3[:, -1], longer.force_EN3)
    assert torch.equal(longer.distance_history_ESN[:, -1], longer.distance_EN)
    bench.view.buffers.clear(torch.tensor([True, False]))
    bench.driver.forget()
    held = bench.view.contact_points("points").force_history_ESN3
    assert (held[0] == 0.0).all() and held[1].any()


def test_without_partners_anything_counts_and_names_are_checked():
    sensor = ContactPoints(geoms=("left", "right"), against=(), num_slots=2)
    bench = SensorBench(SCENE, 1, {"points": sensor})
    bench.place(qpos=torch.tensor([-0.1, 0.0, 0.048, 1.0, 0.0, 0.0, 0.0]))
    bench.step(2)
    assert bench.view.contact_points("points").found_EN.tolist() == [[1.0, 0.0, 1.0, 0.0]]
    for fields, message in (
        ({"bodies": ("plank",), "against": ("wal",)}, "no body 'wal': did you mean 'wall'"),
        ({"bodies": ("plan",)}, "no body matches 'plan'"),
    ):
        with pytest.raises(ValueError, match=message):
            ContactPoints(**fields).add_to(mujoco.MjSpec.from_string(SCENE), "points")
    for fields in ({}, {"geoms": ("left",), "bodies": ("plank",)}):
        with pytest.raises(ValueError, match="give exactly one of them"):
            ContactPoints(**fields)
    with pytest.raises(ValueError, match="num_slots=0"):
        ContactPoints(geoms=("left",), num_slots=0)
    with pytest.raises(ValueError, match="no ContactPoints 'touch'"):
        SensorBench(SCENE, 1, {"touch": ContactSensor(geoms=("left",))}).view.contact_points(
            "touch"
        )
