"""Each randomized field, written into the C engine's model, gives the trajectory of that world."""

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl import mdp
from ksim_rl.testing.sync_count import count_syncs
from tests.mdp.randomization.randomize_bench import Runners

E = 3
SUBSTEPS = 60

EVENTS = {
    "friction": mdp.RandomizeGeomFriction(
        geoms=".*_foot", ranges={0: (0.3, 1.5), 1: (0.005, 0.05)}
    ),
    "size": mdp.RandomizeGeomSize(geoms=".*_foot", ranges={0: (1.1, 1.4)}, operation="scale"),
    "geom_pos": mdp.RandomizeGeomPos(geoms=".*_foot", ranges=(-0.03, 0.03)),
    "geom_quat": mdp.RandomizeGeomQuat(
        geoms="right_foot", ranges={"pitch": (0.4, 0.8), "roll": (-0.2, 0.2)}
    ),
    "mass": mdp.RandomizeBodyMass(bodies=("trunk", "left_leg"), ranges=(0.7, 1.5)),
    "inertia": mdp.RandomizeBodyInertia(
        bodies="trunk", ranges=(0.3, 3.0), distribution="log_uniform"
    ),
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

# What only the richer model has, and moves it.
RICH_EVENTS = {
    "body_pos": mdp.RandomizeBodyPos(bodies=("left_leg", "tail"), ranges=(-0.02, 0.02)),
    "body_quat": mdp.RandomizeBodyQuat(bodies=("left_leg", "tail"), ranges={"roll": (-0.3, 0.3), "yaw": (-0.3, 0.3)}),
    "site_pos": mdp.RandomizeSitePos(sites="nozzle", ranges=(-0.05, 0.05)),
    "site_quat": mdp.RandomizeSiteQuat(sites="nozzle", ranges={"pitch": (-0.5, 0.5)}),
    "tendon_stiffness": mdp.RandomizeTendonStiffness(tendons="strap", ranges=(0.2, 3.0), operation="scale"),
    "tendon_damping": mdp.RandomizeTendonDamping(tendons="strap", ranges=(0.1, 2.0)),
    "tendon_friction_loss": mdp.RandomizeTendonFrictionLoss(tendons="strap", ranges=(0.05, 1.0)),
    "tendon_armature": mdp.RandomizeTendonArmature(tendons="strap", ranges=(0.02, 0.1)),
    "pair_friction": mdp.RandomizePairFriction(pairs="sole", ranges={0: (0.1, 1.0), 1: (0.1, 1.0), 2: (0.005, 0.05)}),
}  # fmt: skip
# What is seen, and moves nothing.
SEEN_EVENTS = {
    "camera_pos": mdp.RandomizeCameraPos(cameras=".*", ranges=(-0.1, 0.1)),
    "camera_quat": mdp.RandomizeCameraQuat(
        cameras="eye", ranges={"roll": (-0.2, 0.2), "yaw": (0.1, 0.3)}
    ),
    "field_of_view": mdp.RandomizeCameraFieldOfView(
        cameras="eye", ranges=(0.8, 1.2), operation="scale"
    ),
    "intrinsic": mdp.RandomizeCameraIntrinsic(
        cameras="lens", ranges={0: (0.9, 1.1), 1: (0.9, 1.1)}
    ),
    "light_pos": mdp.RandomizeLightPos(lights=("lamp", "torch"), ranges=(-0.1, 0.1)),
    "light_dir": mdp.RandomizeLightDir(
        lights=".*", ranges={"roll": (-0.3, 0.3), "pitch": (-0.3, 0.3)}
    ),
    "light_diffuse": mdp.RandomizeLightColor(lights="torch", ranges=(0.2, 0.9)),
    "light_ambient": mdp.RandomizeLightColor(lights="torch", part="ambient", ranges=(0.0, 0.2)),
    "light_specular": mdp.RandomizeLightColor(lights="torch", part="specular", ranges=(0.0, 0.2)),
    "material_color": mdp.RandomizeMaterialColor(materials="paint", ranges={0: (0.0, 1.0)}),
    "material_emission": mdp.RandomizeMaterialShine(
        materials="paint", part="emission", ranges=(0.0, 1.0)
    ),
    "material_specular": mdp.RandomizeMaterialShine(materials="paint", ranges=(0.0, 1.0)),
    "material_shininess": mdp.RandomizeMaterialShine(
        materials="paint", part="shininess", ranges=(0.0, 1.0)
    ),
    "geom_color": mdp.RandomizeGeomColor(geoms=".*_foot", ranges={1: (0.0, 1.0)}),
}
ALL = EVENTS | RICH_EVENTS | SEEN_EVENTS


@pytest.fixture(scope="module")
def plain_runners():
    return Runners(E)


@pytest.fixture(scope="module")
def rich_runners():
    return Runners(E, rich=True)


@pytest.fixture
def runners(request, plain_runners, rich_runners):
    """The worlds of the model that has what the event of this test randomizes."""
    return plain_runners if request.node.callspec.params["name"] in EVENTS else rich_runners


@pytest.mark.parametrize("name", EVENTS | RICH_EVENTS)
def test_each_world_moves_as_the_c_engine_with_its_model(runners, name):
    event, undisturbed = ALL[name], runners.c_run(runners.world.mj_model, SUBSTEPS)
    runners.restart()
    runners.fire(event)
    ends = runners.run(SUBSTEPS)
    for row in range(E):
        expected = runners.c_run(runners.c_model(row, event.per_world_fields), SUBSTEPS)
        effect = np.abs(expected - undisturbed).max()
        assert effect > 1e-3, "the field makes no difference here"
        assert np.abs(ends[row] - expected).max() < 0.005 * effect
    assert np.ptp(ends, axis=0).max() > 1e-3, "the worlds do not differ"


@pytest.mark.parametrize("name", SEEN_EVENTS)
def test_cameras_and_lights_stand_where_the_c_engine_has_them(runners, name):
    """Only randomized poses move any; what colours and lenses do is in the pictures (`test_randomized_looks`)."""
    event, world = ALL[name], runners.world
    runners.restart()
    runners.fire(event)
    runners.place()
    for launch in (mjw.kinematics, mjw.com_pos, mjw.camlight):
        launch(world.warp_model, world.warp_data_E)
    names = ("cam_xpos", "cam_xmat", "light_xpos", "light_xdir")
    seen = {key: wp.to_torch(getattr(world.warp_data_E, key)) for key in names}
    undisturbed = runners.c_placed(world.mj_model)
    for row in range(E):
        model = runners.c_model(row, event.per_world_fields)
        for field in event.per_world_fields:
            own = getattr(world.mj_model, field)
            assert not np.allclose(getattr(model, field), own), "the worlds are as the model"
        expected, moved = runners.c_placed(model), []
        for key in names:
            wanted = getattr(expected, key).reshape(seen[key][row].shape)
            np.testing.assert_allclose(seen[key][row], wanted, atol=2e-6, err_msg=key)
            moved.append(not np.allclose(wanted, getattr(undisturbed, key).reshape(wanted.shape)))
        assert any(moved) == name.endswith(("pos", "quat", "dir"))


def test_elements_turn_about_their_own_axes(rich_runners):
    rich_runners.restart()
    rich_runners.fire(mdp.RandomizeSiteQuat(sites="nozzle", ranges={"yaw": (np.pi / 2, np.pi / 2)}))
    own, turned = np.zeros(9), np.zeros(9)
    site = rich_runners.world.mj_model.site("nozzle")
    mujoco.mju_quat2Mat(own, site.quat)
    mujoco.mju_quat2Mat(turned, rich_runners.world.field("site_quat")[0, site.id].double().numpy())
    own, turned = own.reshape(3, 3), turned.reshape(3, 3)
    np.testing.assert_allclose(
        turned, np.stack((own[:, 1], -own[:, 0], own[:, 2]), axis=-1), atol=1e-6
    )


def test_mass_com_and_inertia_events_of_one_reset_act_together(plain_runners):
    runners = plain_runners
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


@pytest.mark.parametrize("name", ALL)
def test_other_rows_keep_all_fields_and_constants_bit_for_bit(runners, name):
    runners.restart()
    runners.fire(ALL[name], scope="events/before")
    before = {key: value.clone() for key, value in runners.world.state_dict().items()}
    runners.view.reset_count_E.add_(1)
    mask_E = torch.tensor([False, True, False])
    runners.fire(ALL[name], mask_E)
    after = runners.world.state_dict()
    for key, value in before.items():
        if key.startswith("field/"):
            assert torch.equal(after[key][~mask_E], value[~mask_E]), key
    assert any(
        not torch.equal(after[f"field/{f}"][1], before[f"field/{f}"][1])
        for f in ALL[name].per_world_fields
    )
    for key in before:
        if not key.startswith("field/"):
            assert torch.equal(after[key], before[key]), key


@pytest.mark.parametrize("name", ALL)
def test_the_host_never_waits(runners, name):
    event, mask_E = ALL[name], torch.tensor([False, True, False])
    runners.restart()
    runners.fire(event, mask_E)
    with count_syncs() as count:
        runners.fire(event, mask_E)
    assert count.total == 0, count.calls
