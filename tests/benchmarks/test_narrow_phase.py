"""The comparison of contacts with the C engine puts geoms in each other, and says how far they differ."""

import mujoco
import pytest
import torch

from benchmarks.narrow_phase import PAIRS, compared, model, touching


@pytest.mark.parametrize("pair", [("plane", "box"), ("hfield", "sphere"), ("sphere", "capsule")])
@pytest.mark.parametrize("upright", [False, True])
def test_what_our_kernels_find_is_as_in_the_c_engine(pair: tuple[str, str], upright: bool):
    mj_model = model(*pair, margin=1e-6)
    pose_EL = touching(mj_model, 6, depth=0.005, upright=upright)
    mj_data = mujoco.MjData(mj_model)
    for qpos in pose_EL.double().numpy():
        mj_data.qpos[:] = qpos
        mujoco.mj_forward(mj_model, mj_data)
        assert -0.006 < mj_data.contact.dist.min() < 0.0
    found = compared(mj_model, pose_EL, torch.device("cpu"))
    assert found["as_many"] == 1.0 and found["depth_mm"] < 1e-2 and found["normal_degrees"] < 0.1


def test_all_kinds_of_pairs_are_compared():
    assert len(PAIRS) == len(set(PAIRS)) == 2 * 6 + 21
