"""Contacts with height fields on the GPU are those on the CPU, in graphs too."""

import numpy as np
import pytest

from tests.physics.test_height_fields import BODIES, NUM_ENVS, Contacts, lowered, model, noise, poses

pytestmark = pytest.mark.gpu


def test_contacts_are_those_on_the_cpu():
    mj_model = model(noise())
    pose_EL = poses()
    for body in BODIES[:3]:
        pose_EL = lowered(mj_model, pose_EL, body, 0.004)
    expected, actual = (Contacts(mj_model, pose_EL, device) for device in ("cpu", "cuda"))
    for row in range(NUM_ENVS):
        for body in BODIES[:3]:
            theirs, ours = expected.of(row, body), actual.of(row, body)
            assert np.allclose(ours["dist"], theirs["dist"], atol=1e-5), (row, body)
    # Three more steps: eager once, then recorded and replayed.
    for contacts in (expected, actual):
        for _ in range(3):
            contacts.world.step()
    # The third body of other shapes is not compared: it falls alike, but nothing of ours touches it.
    columns = slice(0, 21)
    assert np.allclose(actual.world.qpos_EL[:, columns].cpu(), expected.world.qpos_EL[:, columns], atol=1e-3)
