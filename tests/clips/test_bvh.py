"""BVH files: a chain of two bones by hand, both conventions of the vertical axis, and what is wrong in a line."""

import numpy as np
import pytest

from ksim_rl.clips.bvh import read_bvh
from ksim_rl.clips.recording import from_rotation_vector, multiply

CHAIN = """HIERARCHY
ROOT hips
{
  OFFSET 0 10 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT knee
  {
    OFFSET 0 -50 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -40 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.02
0 90 0 0 0 0 0 0 0
5 90 20 0 90 0 0 -90 30
"""


def read(tmp_path, text=CHAIN, **options):
    path = tmp_path / "walk.bvh"
    path.write_text(text)
    return read_bvh(path, **options)


def test_two_bones_hang_and_swing(tmp_path):
    found = read(tmp_path, scale=0.01, y_up=False)
    assert (found.fps, found.names) == (50.0, ("hips", "knee", "knee_end"))
    assert found.pos_FN3[0] == pytest.approx(np.array(((0, 1, 0), (0, 0.5, 0), (0, 0.1, 0))))
    # The hips turn by 90 degrees about x, which brings -y to -z; the knee turns back, about x as well.
    assert found.pos_FN3[1] == pytest.approx(
        np.array(((0.05, 1, 0.2), (0.05, 1, -0.3), (0.05, 0.6, -0.3)))
    )
    degrees = np.radians((90.0, -90.0, 30.0))
    hips, back, about_y = (
        from_rotation_vector(np.array(turn))
        for turn in ((degrees[0], 0, 0), (degrees[1], 0, 0), (0, degrees[2], 0))
    )
    assert found.quat_FN4[1, 1] == pytest.approx(multiply(multiply(hips, back), about_y))


def test_y_becomes_the_vertical_axis_and_z_the_one_ahead(tmp_path):
    plain, upright = read(tmp_path, y_up=False), read(tmp_path)
    x, y, z = np.moveaxis(plain.pos_FN3, -1, 0)
    assert upright.pos_FN3 == pytest.approx(np.stack((z, x, y), axis=-1))
    # A quarter turn about x, which is the left axis then.
    expected = multiply(np.full(4, 0.5), from_rotation_vector(np.array((np.pi / 2, 0, 0))))
    assert upright.quat_FN4[1, 0] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("HIERARCHY", "", "line 2: 'ROOT' in place of HIERARCHY"),
        ("Yposition", "Yplace", "line 5: channel 'Yplace', valid: Xposition"),
        ("OFFSET 0 -50 0", "OFFSET 0 low 0", "line 8: 'low' in place of a number"),
        ("OFFSET 0 -50 0", "OFFSET 0 nan 0", "line 8: 'nan', which is not finite"),
        ("-90 30", "", "line 20: the end of the file in place of a word"),
        ("Frames: 2", "Frames: 1", "line 18: 1 frames of 0.02 s"),
        ("End Site", "Stop", "line 10: 'Stop' in place of JOINT"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path, old, new, message):
    with pytest.raises(ValueError, match=rf"motion .*walk\.bvh: {message}.*: expected a BVH file"):
        read(tmp_path, CHAIN.replace(old, new, 1))
