"""What docs/motions.md says: its table of motions, and its pairs, which make a person's movement the robot's."""

import re
from pathlib import Path

import numpy as np
import pytest

from ksim_rl.clips.amass import JOINTS, read_amass
from ksim_rl.clips.recording import of_robot
from ksim_rl.clips.retarget import read_retarget, retargeted
from ksim_rl.scene.motions.motion import motion_path
from ksim_rl.tracking.g1_motions import CLIPS
from tests.tracking.g1 import g1_model

PAGE = (Path(__file__).parents[2] / "docs" / "motions.md").read_text()


@pytest.mark.parametrize("name", CLIPS)
def test_seconds_and_speeds_are_those_of_the_file(name):
    found = re.search(rf"\| `{name}` \| [^|]+ \| ([\d.]+) \| ([\d.]+) rad/s", PAGE)
    assert found is not None
    with np.load(motion_path(name)) as file:
        assert float(found[1]) == pytest.approx((len(file["qpos"]) - 1) / file["fps"], abs=0.06)
        assert float(found[2]) == pytest.approx(
            np.percentile(np.abs(file["qvel"][:, 6:]), 95.0), abs=0.06
        )


def test_the_pairs_of_the_page_let_g1_stand_and_lift_a_knee_as_a_person_does(tmp_path):
    model = g1_model()
    text = re.search(r"<!-- test: pairs -->\n```yaml\n(.*?)```", PAGE, re.DOTALL)
    assert text is not None
    (tmp_path / "pairs.yaml").write_text(text[1])
    cfg = read_retarget(tmp_path / "pairs.yaml")
    poses, half_s = np.zeros((61, 66)), 30
    poses[:, :3] = (2 * np.pi / 3 / np.sqrt(3),) * 3  # upright and facing x: y up, z ahead
    lift_F = 0.5 - 0.5 * np.cos(np.arange(61) * np.pi / half_s)
    for joint, turn in (("left_hip", -1.0), ("left_knee", 1.4)):
        poses[:, 3 * JOINTS.index(joint)] = turn * lift_F
    trans = np.tile((0.0, 0.0, 0.92), (61, 1))
    np.savez(tmp_path / "person.npz", poses=poses, trans=trans, mocap_framerate=np.array(60.0))
    recording = read_amass(tmp_path / "person.npz")
    qpos_FL = retargeted(recording, model, cfg, fps=50.0)
    done = of_robot(model, qpos_FL, 50.0)
    left, right = (
        done.pos_FN3[:, done.names.index(f"{side}_ankle_roll_link"), 2]
        for side in ("left", "right")
    )
    ankle = recording.resampled(50.0).pos_FN3[:, JOINTS.index("left_ankle"), 2]
    assert np.ptp(left) == pytest.approx(cfg.scale * np.ptp(ankle), rel=0.15)
    assert np.ptp(right) < 0.02, "the other leg stands"
    knee = int(model.joint("left_knee_joint").qposadr[0])
    assert qpos_FL[25, knee] - qpos_FL[0, knee] > 0.8
    assert np.abs(np.diff(qpos_FL[:, 7:], axis=0)).max() < 0.15
