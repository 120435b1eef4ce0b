"""Contacts with height fields on the GPU, by the first, eager step and by a replay of its graph."""

import pytest
import torch

from tests.gpu.no_syncs import no_syncs
from tests.physics.test_height_fields import (
    BODIES,
    Contacts,
    check_contacts,
    lowered,
    model,
    noise,
    poses,
)

pytestmark = pytest.mark.gpu


def find_by_replay(contacts: Contacts, pose_EL: torch.Tensor) -> None:
    """Let the world record its graphs, and find the contacts by replays of them."""
    for _ in range(2):
        contacts.find(pose_EL)
    with no_syncs():
        contacts.world.step()
    contacts.find(pose_EL)


def test_contacts_on_rough_ground_are_those_of_the_c_engine():
    mj_model, pose_EL = model(noise()), poses()
    for body in BODIES[:3]:
        pose_EL = lowered(mj_model, pose_EL, body, 0.01)
    contacts = Contacts(mj_model, pose_EL, "cuda")
    for find in (lambda: None, lambda: find_by_replay(contacts, pose_EL)):
        find()
        for body in BODIES[:3]:
            check_contacts(contacts, pose_EL, body)
