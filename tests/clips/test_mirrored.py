"""A mirrored motion: MuJoCo puts each body where the mirror image of its counterpart is."""

import mujoco
import numpy as np

from ksim_rl.clips.mirrored import mirrored
from ksim_rl.scene.motions.motion import motion_path
from tests.tracking.g1 import g1_model


def test_bodies_are_where_their_counterparts_were_in_the_mirror():
    model = g1_model()
    with np.load(motion_path("g1_kick")) as file:
        qpos_FL = file["qpos"][90:200:25].astype(float)
    image_FL = mirrored(model, qpos_FL)
    own = mujoco.MjData(model)
    image = mujoco.MjData(model)
    for qpos, image_qpos in zip(qpos_FL, image_FL, strict=True):
        own.qpos[:] = qpos
        image.qpos[:] = image_qpos
        mujoco.mj_kinematics(model, own)
        mujoco.mj_kinematics(model, image)
        for body in range(1, model.nbody):
            name = model.body(body).name
            other = (
                name.translate(str.maketrans({})).replace("left", "RIGHT").replace("right", "left")
            )
            other = other.replace("RIGHT", "right")
            wanted_3 = own.xpos[body] * (1.0, -1.0, 1.0)
            np.testing.assert_allclose(image.body(other).xpos, wanted_3, atol=2e-3, err_msg=name)
    assert np.abs(mirrored(model, image_FL) - qpos_FL).max() < 1e-12
