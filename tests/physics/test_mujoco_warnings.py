"""Warnings of a simulation are shown, and written into no file of the working directory."""

import subprocess
import sys

import mujoco
import pytest

from ksim_rl.physics import mujoco_warnings

EXPLODES = """\
import mujoco
from mujoco.batch import Batch
import ksim_rl.physics
model = mujoco.MjModel.from_xml_string('''
<mujoco><option timestep="0.1"/><worldbody><body>
  <joint name="j" type="slide" stiffness="-1e8"/><geom size="1"/>
</body></worldbody></mujoco>''')
batch = Batch(model, 4, 2)
batch.bind("qvel")[:] = 1e6
for _ in range(60):
    batch.step()
data = mujoco.MjData(model)
data.qvel[0] = 1e6
for _ in range(60):
    mujoco.mj_step(model, data)
"""


def test_no_file_is_written_into_the_working_directory_and_a_kind_is_shown_once(tmp_path):
    outside = tmp_path / "outside"
    stands = tmp_path / "stands"
    stands.mkdir()
    (stands / "MUJOCO_LOG.TXT").symlink_to(outside)
    command = [sys.executable, "-P", "-c", EXPLODES]
    ended = subprocess.run(
        command, cwd=stands, timeout=60, check=True, capture_output=True, text=True
    )
    assert not outside.exists()
    assert ended.stderr.count("warning: MuJoCo: Nan, Inf or huge value in QACC at DOF 0.") == 1


@pytest.mark.parametrize("own", [True, False])
def test_a_handler_of_the_program_stays(own):
    before = mujoco.get_mju_user_warning()
    try:
        mujoco.set_mju_user_warning(print if own else None)
        mujoco_warnings.show_warnings()
        assert (mujoco.get_mju_user_warning() is print) == own
    finally:
        mujoco.set_mju_user_warning(before)
