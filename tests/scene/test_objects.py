"""Objects, by MuJoCo's compiler and its engine."""

import mujoco
import numpy as np
import pytest

from ksim_rl.scene.objects import Box, Capsule, Cylinder, Mesh, Sphere

# A wedge whose origin is none of its middles: 2 x 1 x 1 on the plane.
WEDGE = (
    "".join(
        f"v {x} {y} {z}\n"
        for x, y, z in ((0, 0, 0), (2, 0, 0), (0, 1, 0), (2, 1, 0), (0, 0, 1), (0, 1, 1))
    )
    + "f 1 3 4\nf 1 4 2\nf 5 2 4\nf 5 4 6\nf 1 5 6\nf 1 6 3\nf 1 2 5\nf 3 6 4\n"
)


def test_size_mass_and_friction():
    model = (
        Box(size=(0.1, 0.2, 0.3), mass=1.2, friction=(0.4, 0.01, 0.002), rgba=(1.0, 0.0, 0.0, 0.5))
        .spec()
        .compile()
    )
    body, geom = model.body("box"), model.geom("box")
    assert body.pos.tolist() == [0.0, 0.0, 0.15], "it stands on z = 0"
    assert body.mass[0] == pytest.approx(1.2)
    # A solid cuboid: m (b^2 + c^2) / 12 about each axis.
    moments = sorted(
        [1.2 / 12 * (0.2**2 + 0.3**2), 1.2 / 12 * (0.1**2 + 0.3**2), 1.2 / 12 * (0.1**2 + 0.2**2)]
    )
    assert sorted(body.inertia.tolist()) == pytest.approx(moments)
    assert geom.friction.tolist() == [0.4, 0.01, 0.002] and geom.rgba.tolist() == [
        1.0,
        0.0,
        0.0,
        0.5,
    ]
    assert (model.nq, model.nv) == (7, 6)


@pytest.mark.parametrize("kind", ["box", "sphere", "cylinder", "capsule", "mesh"])
def test_each_rests_where_it_starts(kind, tmp_path):
    file = tmp_path / "a wedge.obj"
    file.write_text(WEDGE)
    things = {
        "box": Box(size=(0.1, 0.1, 0.2), mass=0.5),
        "sphere": Sphere(radius=0.05, mass=0.5),
        "cylinder": Cylinder(radius=0.05, length=0.12, mass=0.5),
        "capsule": Capsule(radius=0.03, length=0.12, mass=0.5),
        "mesh": Mesh(file=str(file), scale=(0.1, 0.1, 0.1), mass=0.5),
    }
    spec = things[kind].spec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1.0, 1.0, 1.0])
    model = spec.compile()
    data = mujoco.MjData(model)
    assert model.body(kind).mass[0] == pytest.approx(0.5)
    assert model.jnt(kind).type == mujoco.mjtJoint.mjJNT_FREE and model.geom(kind).id >= 0
    start = data.qpos.copy()
    for _ in range(200):
        mujoco.mj_step(model, data)
    assert data.ncon > 0, "it touches the plane"
    np.testing.assert_allclose(data.qpos, start, atol=2e-3)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"size": (0.1, 0.0, 0.1)}, r"size\[1\]=0\.0"),
        ({"mass": -1.0}, r"mass=-1\.0"),
        ({"friction": (1.0, -0.1, 0.0)}, r"friction\[1\]=-0\.1"),
        ({"rgba": (1.0, 1.0, 1.0, 1.5)}, r"rgba\[3\]=1\.5"),
    ],
)
def test_values_out_of_range_name_the_field(fields, message):
    with pytest.raises(ValueError, match=message):
        Box(**fields)


def test_what_is_no_mesh_is_refused(tmp_path):
    with pytest.raises(ValueError, match="name the file of a mesh"):
        Mesh(file="")
    with pytest.raises(ValueError, match=r"nothing\.obj"):
        Mesh(file=str(tmp_path / "nothing.obj")).spec()
