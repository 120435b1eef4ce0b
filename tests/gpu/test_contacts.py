"""Contacts of boxes and of steep capsules on a GPU agree with the C engine."""

import pytest

from tests.physics.test_contacts import check_contacts

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("turned", ["", 'euler="20 10 0"'])
def test_boxes_and_steep_rods_touch_as_in_the_c_engine(turned):
    check_contacts(turned, device="cuda")
