"""Each randomized field, written into the C engine's model, gives the trajectory of that world."""

import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.testing.sync_count import count_syncs
from tests.mdp.randomization.randomize_bench import FIELDS, Runners

E = 3
SUBSTEPS = 60

EVENTS = {
    "friction": mdp.RandomizeGeomFriction(geoms=".*_foot", ranges={0: (0.3, 1.5), 1: (0.005, 0.05)}),
    "size": mdp.RandomizeGeomSize(geoms=".*_foot", ranges={0: (1.1, 1.4)}, operation="scale"),
    "geom_pos": mdp.RandomizeGeomPos(geoms=".*_foot", ranges=(-0.03, 0.03)),
    "geom_quat": mdp.RandomizeGeomQuat(geoms="right_foot", ranges={"pitch": (0.4, 0.8), "roll": (-0.2, 0.2)}),
    "mass": mdp.RandomizeBodyMass(bodies=("trunk", "left_leg"), ranges=(0.7, 1.5)),
    "inertia": mdp.RandomizeBodyInertia(bodies="trunk", ranges=(0.3, 3.0), distribution="log_uniform"),
    "com": mdp.RandomizeBodyCom(bodies="trunk", ranges=(-0.05, 0.05), operation="add"),
    "pseudo_inertia": mdp.RandomizePseudoInertia(
        bodies=("trunk", "left_leg"),
        alpha=(-0.2, 0.2),
        stretch=(-0.3, 0.3),
        shear=(-0.3, 0.3),
        shift=(-0.04, 0.04),
    ),
    "damping": mdp.RandomizeJointDamping(ranges=(0.1, 0.6)),
    "armature": mdp.RandomizeJointArmature(ranges=(0.02, 0.1)),
    "friction_loss": mdp.RandomizeJointFrictionLoss(ranges=(0.1, 1.0)),
    "stiffness": mdp.RandomizeJointStiffness(ranges=(2.0, 20.0)),
    "range": mdp.RandomizeJointRange(joints="left_hip", ranges={1: (-0.3, -0.05)}),
    "zero": mdp.RandomizeJointZero(ranges=(-0.2, 0.2)),
    "gains": mdp.RandomizeActuatorGains(joints=("left_hip", "tail"), damping=(0.5, 3.0)),
    "stiff_gains": mdp.RandomizeActuatorGains(joints="left_hip", stiffness=(0.05, 0.9)),
    "effort_limit": mdp.RandomizeEffortLimit(joints=".*_hip", ranges=(0.2, 0.7)),
    "gravity": mdp.RandomizeGravity(ranges={0: (-3.0, 3.0), 2: (-2.0, 2.0)}),
}


@pytest.fixture(scope="module")
def runners():
    return Runners(E)


@pytest.fixture(scope="module")
def undisturbed(runners):
    return runners.c_run(runners.world.mj_model, SUBSTEPS)


@pytest.mark.parametrize("name", EVENTS)
def test_each_world_moves_as_the_c_engine_with_its_model(runners, undisturbed, name):
    event = EVENTS[name]
    runners.restart()
    runners.fire(event)
    ends = runners.run(SUBSTEPS)
    for row in range(E):
        expected = runners.c_run(runners.c_model(row, event.per_world_fields), SUBSTEPS)
        effect = np.abs(expected - undisturbed).max()
        assert effect > 1e-3, "the field makes no difference here"
        assert np.abs(ends[row] - expected).max() < 0.005 * effect
    assert np.ptp(ends, axis=0).max() > 1e-3, "the worlds do not differ"


def test_mass_com_and_inertia_events_of_one_reset_act_together(runners):
    runners.restart()
    fields = []
    for number, name in enumerate(("mass", "inertia", "com")):
        with runners.driver.scope(f"events/{number}", runners.view.reset_count_E):
            EVENTS[name](runners.view, runners.everybody_E)
        fields += EVENTS[name].per_world_fields
    runners.world.set_const(fields, runners.everybody_E)
    for row, end in enumerate(runners.run(SUBSTEPS)):
        expected = runners.c_run(runners.c_model(row, fields), SUBSTEPS)
        np.testing.assert_allclose(end, expected, atol=2e-3)


@pytest.mark.parametrize("name", EVENTS)
def test_other_rows_keep_all_fields_and_constants_bit_for_bit(runners, name):
    runners.restart()
    runners.fire(EVENTS[name], scope="events/before")
    before = {key: value.clone() for key, value in runners.world.state_dict().items()}
    runners.view.reset_count_E.add_(1)
    mask_E = torch.tensor([False, True, False])
    runners.fire(EVENTS[name], mask_E)
    after = runners.world.state_dict()
    for key, value in before.items():
        if key.startswith("field/"):
            assert torch.equal(after[key][~mask_E], value[~mask_E]), key
    assert any(
        not torch.equal(after[f"field/{f}"][1], before[f"field/{f}"][1])
        for f in EVENTS[name].per_world_fields
    )
    for key in before.keys() - {f"field/{name}" for name in FIELDS}:
        if not key.startswith("field/"):
            assert torch.equal(after[key], before[key]), key


@pytest.mark.parametrize("name", EVENTS)
def test_the_host_never_waits(runners, name):
    event, mask_E = EVENTS[name], torch.tensor([False, True, False])
    runners.restart()
    runners.fire(event, mask_E)
    with count_syncs() as count:
        runners.fire(event, mask_E)
    assert count.total == 0, count.calls
