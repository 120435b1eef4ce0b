"""The box, by MuJoCo's compiler."""

import pytest

from ksim_rl.scene.objects import Box


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
