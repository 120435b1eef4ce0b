import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.scene.sensors import ContactSensor

AT_REST = (0, 0, 0.1, 1, 0, 0, 0, 1, 0, 0.1, 1, 0, 0, 0)
HAMMER = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -10"/>
  <worldbody>
    <body name="frame">
      <geom name="anvil" type="box" size="0.2 0.2 0.05"/>
      <body name="guide" pos="0.5 0 0"><geom size="0.01" mass="0.1"/>
        <body name="hammer" pos="-0.5 0 0.1">
          <joint name="fall" type="slide" axis="0 0 1"/><geom name="head" type="sphere" size="0.05" mass="2"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
"""A hammer of 2 kg that falls on the anvil of its own machine."""


def test_forces_count_above_the_threshold_only(boxes):
    lifted = (*AT_REST[:9], 0.9, 1, 0, 0, 0)
    boxes.place(qpos=[AT_REST, lifted])
    for _ in range(20):
        boxes.step()
    # Weights of 30 N and 10 N; the second box of the second world is in the air.
    for threshold, expected in ((0.0, [40.0, 30.0]), (5.0, [30.0, 25.0]), (20.0, [10.0, 10.0])):
        value = boxes.read(mdp.ContactForceAbove(sensor="touch", threshold=threshold), "rewards/x")
        torch.testing.assert_close(value, torch.tensor(expected), atol=0.5, rtol=0)
    for threshold, expected in ((1.0, [2.0, 1.0]), (20.0, [1.0, 1.0]), (31.0, [0.0, 0.0])):
        value = boxes.read(mdp.UndesiredContacts(sensor="touch", threshold=threshold), "rewards/x")
        assert value.tolist() == expected


def substeps_above(model, height, *, steps, threshold):
    """Count by the C engine, per env step of 10 substeps, those in which the contact force exceeds the threshold."""
    data, force = mujoco.MjData(model), np.zeros(6)
    data.qpos[0] = height
    counts = []
    for _ in range(steps):
        counts.append(0)
        for _ in range(10):
            mujoco.mj_step(model, data)
            # The forces still belong to the start of the step, as sensors see them.
            hit = False
            for contact in range(data.ncon):
                mujoco.mj_contactForce(model, data, contact, force)
                hit |= bool(np.linalg.norm(force[:3]) > threshold)
            counts[-1] += hit
    return counts


def test_self_collision_counts_the_substeps_of_a_hard_contact(make_bench):
    sensor = ContactSensor(
        subtrees=("frame",),
        against="frame",
        against_kind="subtree",
        reduce="strongest",
        every_substep=True,
    )
    bench = make_bench(HAMMER, 2, {"own": sensor})
    bench.place(qpos=[[0.06], [1.0]])
    term, counts = mdp.SelfCollision(sensor="own"), []
    illegal, ended = mdp.IllegalContact(sensor="own", threshold=10.0), []
    for _ in range(30):
        bench.step()
        # One substep is enough to end an episode.
        ended.append(bench.read(illegal, "terminations/x").tolist()[0])
        counts.append(bench.read(term, "rewards/x").tolist())
    falling, hovering = zip(*counts, strict=True)
    expected = substeps_above(bench.world.mj_model, 0.06, steps=30, threshold=10.0)
    assert list(falling) == expected
    assert ended == [count > 0 for count in expected]
    assert set(hovering[:20]) == {0.0}
    # It lands within an env step, and in the end the 20 N of its weight exceed 10 N in each substep, never 30 N.
    assert {count for count in expected if 0 < count < 10} and expected[-1] == 10
    assert (
        bench.read(mdp.SelfCollision(sensor="own", threshold=30.0), "rewards/x").tolist()[0] == 0.0
    )


def test_a_hit_that_is_over_before_the_last_substep_is_illegal_where_all_are_read(make_bench):
    own = {
        "subtrees": ("frame",),
        "against": "frame",
        "against_kind": "subtree",
        "reduce": "strongest",
    }
    sensors = {name: ContactSensor(every_substep=name == "all", **own) for name in ("all", "last")}
    bench = make_bench(HAMMER, 2, sensors)
    # The one is pressed 3 cm deep and thrown up, and has left after seven of ten substeps; the other hovers.
    bench.place(qpos=[[-0.03], [1.0]], qvel=[[0.6], [0.0]])
    bench.step()
    for sensor, ended in (("all", [True, False]), ("last", [False, False])):
        term = mdp.IllegalContact(sensor=sensor, threshold=10.0)
        assert bench.read(term, "terminations/x").tolist() == ended


@pytest.mark.parametrize("term", [mdp.ContactForceAbove, mdp.UndesiredContacts, mdp.SelfCollision])
def test_thresholds_must_not_be_negative(term):
    with pytest.raises(ValueError, match="threshold=-1"):
        term(sensor="touch", threshold=-1)
