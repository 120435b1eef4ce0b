"""A crowd of free bodies, for events that draw."""

import pytest

from tests.mdp.bench import FREE_BODY


@pytest.fixture
def crowd(make_bench):
    """Return 500 worlds of the trunk with two legs."""
    return make_bench(FREE_BODY, 500, soft_joint_pos_limit_factor=0.5)
