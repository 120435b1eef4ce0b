"""Archives as AMASS has them: the standing skeleton, one bent joint, own offsets, and wrong ones."""

import numpy as np
import pytest

from ksim_rl.clips.amass import HEIGHT, JOINTS, read_amass

UPRIGHT = (np.pi / 2, 0.0, 0.0)
"""The pelvis in a world whose z axis points up: y turns to z."""


def saved(tmp_path, **changes):
    poses = np.zeros((3, 156))
    poses[:, :3] = UPRIGHT
    arrays = {
        "poses": poses,
        "trans": np.tile((1.0, 2.0, 0.9), (3, 1)),
        "mocap_framerate": np.array(120.0),
    }
    path = tmp_path / "person.npz"
    np.savez(path, **{key: value for key, value in (arrays | changes).items() if value is not None})
    return path, poses


def at(recording, name, frame=0):
    return recording.pos_FN3[frame, JOINTS.index(name)]


def test_a_person_at_rest_stands_with_arms_stretched_out(tmp_path):
    found = read_amass(saved(tmp_path)[0])
    assert (found.fps, found.names) == (120.0, JOINTS)
    assert at(found, "pelvis") == pytest.approx((1.0, 2.0, 0.9))
    # Facing -y, left is +x.
    assert at(found, "left_ankle") == pytest.approx(
        (1.0 + 0.05 * HEIGHT, 2.0, 0.9 - 0.521 * HEIGHT)
    )
    assert at(found, "left_wrist") == pytest.approx(
        (1.0 + 0.41 * HEIGHT, 2.0, 0.9 + 0.255 * HEIGHT)
    )
    assert at(found, "right_wrist")[0] == pytest.approx(1.0 - 0.41 * HEIGHT)
    assert at(found, "left_foot")[1] == pytest.approx(2.0 - 0.07 * HEIGHT), "toes point ahead"


def test_a_bent_elbow_moves_what_hangs_on_it_and_nothing_else(tmp_path):
    path, poses = saved(tmp_path)
    elbow = 3 * JOINTS.index("left_elbow")
    poses[1, elbow : elbow + 3] = (0.0, -np.pi / 2, 0.0)  # about the vertical: x turns to z, ahead
    straight = read_amass(path)
    bent = read_amass(saved(tmp_path, poses=poses)[0])
    assert at(bent, "left_wrist", 1) == pytest.approx(
        at(straight, "left_elbow") + (0.0, -0.146 * HEIGHT, 0.0)
    )
    moved = np.abs(bent.pos_FN3[1] - straight.pos_FN3[1]).max(-1) > 1e-9
    assert [JOINTS[i] for i in np.flatnonzero(moved)] == ["left_wrist"]


def test_offsets_of_ones_own(tmp_path):
    path, _ = saved(tmp_path)
    found = read_amass(path, offsets={"left_wrist": np.array((0.3, 0.0, 0.0))})
    assert np.linalg.norm(at(found, "left_wrist") - at(found, "left_elbow")) == pytest.approx(0.3)
    with pytest.raises(ValueError, match="offsets: no joint 'tail'"):
        read_amass(path, offsets={"tail": np.zeros(3)})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trans": None}, "no array 'trans': it has poses, mocap_framerate"),
        ({"mocap_framerate": None}, "no array 'mocap_framerate'"),
        ({"poses": np.zeros((3, 30))}, r"poses has shape \(3, 30\): expected \[F, 66 or more\]"),
        ({"trans": np.zeros((2, 3))}, r"trans has shape \(2, 3\): expected \(3, 3\)"),
        ({"trans": np.full((3, 3), np.nan)}, "it holds numbers that are not finite"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=rf"motion .*person\.npz: {message}"):
        read_amass(saved(tmp_path, **changes)[0])


def test_what_is_no_archive_is_refused(tmp_path):
    path = tmp_path / "person.npz"
    path.write_text("poses")
    with pytest.raises(ValueError, match=r"person\.npz: cannot be read as \.npz"):
        read_amass(path)
