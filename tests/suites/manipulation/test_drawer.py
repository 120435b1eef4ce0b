"""The drawer slides as its fields say, and a gripper that is driven by hand in task space opens it."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.physics import load_model
from ksim_rl.scene.objects import Drawer
from tests.absent_models import skipped_without_models


def pulled(drawer, force, seconds=2.0):
    """Return how far a drawer comes out under a force at its slide, by the C engine."""
    model = load_model(drawer.spec())
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = force
    while data.time < seconds:
        mujoco.mj_step(model, data)
    return float(data.qpos[0]), float(data.qvel[0])


def test_a_drawer_slides_as_far_as_it_can_and_not_below_its_friction():
    drawer = Drawer(travel=0.2, friction_loss=2.0)
    # MuJoCo's friction losses are soft, and creep.
    assert abs(pulled(drawer, 1.5)[0]) < 5e-3
    assert pulled(drawer, 6.0)[0] == pytest.approx(0.2, abs=5e-3)
    assert abs(pulled(drawer, -6.0)[0]) < 5e-3
    # (6 - 2) N over 20 N s/m, as soon as it no longer speeds up.
    far = Drawer(travel=5.0, friction_loss=2.0, damping=20.0)
    assert pulled(far, 6.0)[1] == pytest.approx(0.2, rel=0.02)


def test_its_parts_are_where_it_says():
    model = load_model(Drawer(height=0.4).spec())
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert np.allclose(data.site("grip").xpos, (-0.07, 0.0, 0.4))
    data.qpos[0] = 0.1
    mujoco.mj_forward(model, data)
    assert np.allclose(data.site("grip").xpos, (-0.17, 0.0, 0.4)) and data.ncon == 0
    for field in ("travel", "mass"):
        with pytest.raises(ValueError, match=f"{field}=0"):
            Drawer(**{field: 0.0})
    with pytest.raises(ValueError, match="height=0.1"):
        Drawer(height=0.1)


@pytest.fixture(scope="module")
def env():
    with skipped_without_models():
        made = envs.make("panda_open_drawer", num_envs=2, seed=0, overrides=["task.sim.engine=c"])
    yield made
    made.close()


def test_its_parts_have_the_sizes_that_a_policy_sees(env):
    root_E = env.reset()
    # Eight joints twice, six of the hand's axes, three to the handle, the slide twice, four actions.
    assert root_E["actor"].shape == root_E["critic"].shape == (2, 31)
    assert env.action_spec.shape == (2, 4)
    view = env.base_env.view
    away = view.site("drawer/grip").pos_EL - view.site("panda/gripper").pos_EL
    assert torch.equal(root_E["obs", "to_grip"], away) and away.norm(dim=-1).max() < 0.15
    assert float(view.joints("drawer/slide").pos_EL.abs().max()) < 1e-6


def test_a_gripper_that_is_driven_by_hand_opens_it(env):
    root_E = env.reset()
    view = env.base_env.view
    rewards = []
    opened = torch.zeros(2)
    for step in range(150):
        away = (view.site("drawer/grip").pos_EL - view.site("panda/gripper").pos_EL) / 0.03
        # Down to the bar with open fingers, which close; then back, with the bar.
        fingers = torch.full((2, 1), 1.0 if step < 40 else -1.0)
        if step >= 60:
            away[:, 0] = -0.5
        action = torch.cat((away, fingers), -1)
        stepped_E, root_E = env.step_and_maybe_reset(root_E.set("action", action))
        rewards.append(stepped_E["next", "reward"])
        opened = torch.maximum(opened, view.joints("drawer/slide").pos_EL[:, 0])
    assert opened.min() > 0.2
    assert rewards[-1].min() > 2.0 * rewards[40].max() > 0.0
    assert not env.base_env.world.overflow_report().messages
