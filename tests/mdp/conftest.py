"""Benches of the models that most term tests use."""

from collections.abc import Mapping

import pytest

from ksim_rl.scene.sensors import ContactSensor
from tests.mdp.bench import BOXES, FREE_BODY, Bench


@pytest.fixture
def free_body():
    """Three worlds of the trunk with two legs."""
    return Bench(FREE_BODY, 3, {}, soft_joint_pos_limit_factor=0.5)


@pytest.fixture
def make_bench():
    """Build a bench of another model or size."""

    def make(
        source: str,
        num_envs: int,
        contacts: Mapping[str, ContactSensor] | None = None,
        **view: float,
    ) -> Bench:
        return Bench(source, num_envs, contacts or {}, **view)

    return make


@pytest.fixture
def boxes(make_bench):
    """Two worlds with boxes "a" (3 kg) and "b" (1 kg) and the contact sensor "touch"."""
    return make_bench(BOXES, 2, {"touch": ContactSensor(geoms=("a", "b"))})


@pytest.fixture
def crowd(make_bench):
    """Return 500 worlds of the trunk with two legs, for events that draw."""
    return make_bench(FREE_BODY, 500, soft_joint_pos_limit_factor=0.5)
