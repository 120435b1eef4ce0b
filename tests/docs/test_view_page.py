"""The page of what terms can read has all that the view and its parts have, with the shapes and types they have."""

import re

import numpy as np
import pytest
import torch

from benchmarks.pages import view
from ksim_rl.scene.motions.motion import load_motion
from ksim_rl.scene.sensors import (
    CameraSensor,
    ContactPoints,
    ContactSensor,
    ImuSensor,
    RayCaster,
    RingPattern,
)
from tests.mdp.bench import FREE_BODY, Bench

SENSORS = {
    "feet": ContactSensor(geoms=("hull",), against=None),
    "hand": ContactPoints(geoms=("hull",), against=()),
    "imu": ImuSensor(site="imu"),
    "scan": RayCaster(site="imu", pattern=RingPattern()),
    "front": CameraSensor(body="trunk", width=4, height=3, depth=True, segmentation=True),
}
SIZES = {"E": 2, "H": 3, "W": 4}


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """One object of each part, by how the page spells it."""
    bench = Bench(FREE_BODY, SIZES["E"], SENSORS)
    model = bench.world.mj_model
    file = tmp_path_factory.mktemp("motion") / "still.npz"
    qpos = np.tile(model.key_qpos[0], (3, 1))
    np.savez(file, fps=10.0, qpos=qpos, qvel=np.zeros((3, model.nv)))
    seen = bench.view
    return {
        "view": seen,
        'view.joints("hip.*")': seen.joints(".*hip"),
        'view.bodies(".*_foot")': seen.bodies(("left", "right")),
        'view.body("torso")': seen.body("trunk"),
        'view.sites(".*_foot")': seen.sites(".*_foot"),
        'view.site("finger")': seen.site("imu"),
        'view.entity("cube")': seen.entity(),
        "view.robot.ground_scan(points)": seen.robot.ground_scan(((0.5, 0.0),)),
        'view.contact("feet")': seen.contact("feet"),
        'view.contact_points("hand")': seen.contact_points("hand"),
        'view.imu("imu")': seen.imu("imu"),
        'view.rays("scan")': seen.rays("scan"),
        'view.rays("scan").state': seen.rays("scan").state,
        'view.camera("front")': seen.camera("front"),
        "view.terrain": seen.terrain,
        'view.motion("walk.npz")': load_motion(str(file), model, torch.device("cpu")),
    }


@pytest.mark.parametrize("part", view.PARTS, ids=lambda part: part.spelled)
def test_the_page_has_all_that_a_part_has(parts, part) -> None:
    listed = {row.name for row in view.rows(part.owner)}
    listed |= {re.match(r"`(\w+)", cell)[1] for cell, _ in view.methods(part.owner)}
    ignored = (
        {"count", "index"} if hasattr(part.owner, "_fields") else set(vars(view.SensorTracker))
    )
    present = {name for name in dir(parts[part.spelled]) if not name.startswith("_")} - ignored
    assert listed == present


@pytest.mark.parametrize("part", view.PARTS, ids=lambda part: part.spelled)
def test_shapes_and_types_are_those_of_the_tensors(parts, part) -> None:
    compared = 0
    for row in view.rows(part.owner):
        value = getattr(parts[part.spelled], row.name)
        if not isinstance(value, torch.Tensor):
            continue
        kind, letters = re.fullmatch(r"`(\w+ )?\[(.*)\]`", row.shape).groups()
        dims = letters.split(", ") if letters else []
        assert len(dims) == value.ndim, row
        for dim, size in zip(dims, value.shape, strict=True):
            assert size == (int(dim) if dim.isdigit() else SIZES.get(dim, size)), row
        assert str(value.dtype) == f"torch.{(kind or 'float32').strip()}", row
        compared += 1
    assert compared or "bodies" not in part.spelled


def test_quantities_of_physics_have_their_stage() -> None:
    tables = {"default_pos_EL", "soft_limits_L2", "encoder_bias_EL", "state"}
    for part in view.PARTS[1:-2]:
        for row in view.rows(part.owner):
            if row.shape and not row.name.startswith("default_") and row.name not in tables:
                assert row.stage, f"{part.spelled}.{row.name}: name the stage in its docstring"


@pytest.mark.parametrize(
    ("part", "wrong", "right"),
    [
        ("view", "joint_pos", "joint_pos_EL"),
        ("view", "root_lin_vel_b", "root_lin_vel_b_EL"),
        ('view.joints("hip.*")', "vel", "vel_EL"),
        ('view.bodies(".*_foot")', "pos_EL", "pos_EN3"),
        ('view.body("torso")', "lin_vel", "lin_vel_EL"),
        ('view.sites(".*_foot")', "height_E", "height_EN"),
        ('view.site("finger")', "height", "height_E"),
        ('view.entity("cube")', "root_pos", "root_pos_EL"),
        ('view.contact("feet")', "found", "found_EN"),
        ('view.imu("imu")', "lin_acc", "lin_acc_EL"),
        ('view.rays("scan").state', "distance", "distance_EN"),
        ('view.camera("front")', "rgb", "rgb_EHW3"),
        ("view.terrain", "origins", "origins_E3"),
        ('view.motion("walk.npz")', "qpos", "qpos_FL"),
    ],
)
def test_a_wrong_name_gets_the_near_ones(parts, part, wrong, right) -> None:
    with pytest.raises(AttributeError, match=f"no '{wrong}': did you mean .*'{right}'"):
        getattr(parts[part], wrong)


def test_a_property_that_fails_keeps_its_own_error() -> None:
    class Broken(view.Joints):
        @property
        def jerk_EL(self):
            return self._state.nothing

    broken = object.__new__(Broken)
    broken._state = torch.device("cpu")
    with pytest.raises(AttributeError, match="'torch.device' object has no attribute 'nothing'"):
        broken.jerk_EL  # noqa: B018
