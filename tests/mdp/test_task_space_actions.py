"""Actions in task space: Jacobians and steps as MuJoCo's C engine has them, and where the site ends up."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import envs, mdp
from ksim_rl.mdp.task_space_actions import jacobian
from ksim_rl.scene.robots.control_models import Arm

NUM_ENVS = 3
JOINTS = Arm.joints
DAMPING = 0.05


def env_of(**action):
    """Return an env of the small arm on the C engine, whose tip is moved in task space."""
    cfg = envs.make_cfg("arm_reach", ["task.sim.engine=c"])
    moves = mdp.DifferentialIKAction(joints=JOINTS, site=Arm.tip, **action)
    events = {"anywhere": mdp.ResetJoints(joints=JOINTS, position_range=(-0.5, 0.5))}
    cfg = dataclasses.replace(cfg, actions={"tip": moves}, events=events)
    scene = dataclasses.replace(cfg.scene, num_envs=NUM_ENVS)
    return envs.ManagerBasedRlEnv(dataclasses.replace(cfg, scene=scene, seed=0), device="cpu")


@pytest.fixture(scope="module")
def env():
    made = env_of(turns=True, scale=0.1, turn_scale=0.3)
    made.reset()
    yield made
    made.close()


def truth(env, row, joints=JOINTS):
    """Return mj_jacSite's position and orientation rows of a row's state, [6, K]."""
    model = env.world.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = env.world.qpos_EL[row].numpy()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    rows = np.zeros((2, 3, model.nv))
    mujoco.mj_jacSite(model, data, rows[0], rows[1], model.site(Arm.tip).id)
    columns = [int(model.joint(joint).dofadr[0]) for joint in joints]
    return rows.reshape(6, -1)[:, columns]


def test_the_jacobian_is_that_of_the_c_engine(env):
    found = jacobian(env.view, Arm.tip, JOINTS)
    for row in range(NUM_ENVS):
        assert np.allclose(found[row].numpy(), truth(env, row), atol=1e-5)
    # In the order that is asked for.
    turned = tuple(reversed(JOINTS))
    assert torch.equal(jacobian(env.view, Arm.tip, turned), found.flip(-1))


def test_a_step_is_the_damped_least_squares_one(env):
    term = env.cfg.actions["tip"]
    rng = np.random.default_rng(0)
    action = torch.tensor(rng.uniform(-1.0, 1.0, size=(NUM_ENVS, 6)), dtype=torch.float32)
    found = term.step(env.view, action, env.view.joints(JOINTS).pos_EL)
    for row in range(NUM_ENVS):
        own = truth(env, row)
        asked = action[row].double().numpy() * np.repeat((0.1, 0.3), 3)
        # The same by the normal equations in the joints' space.
        normal = own.T @ own + DAMPING**2 * np.eye(len(JOINTS))
        assert np.allclose(found[row].numpy(), np.linalg.solve(normal, own.T @ asked), atol=2e-4)


def test_posture_moves_joints_and_not_the_site(env):
    stays = dataclasses.replace(
        env.cfg.actions["tip"], posture_weight=0.2, turns=False, damping=1e-3
    )
    step = stays.step(env.view, torch.zeros(NUM_ENVS, 3), env.view.joints(JOINTS).pos_EL)
    moved = [truth(env, row)[:3] @ step[row].double().numpy() for row in range(NUM_ENVS)]
    assert step.abs().amax(-1).min() > 1e-3 and np.abs(moved).max() < 1e-4


def test_targets_go_on_from_the_targets_before_and_do_not_run_away(env):
    env.reset()
    term = dataclasses.replace(env.cfg.actions["tip"], max_lead=0.03)
    action = torch.full((NUM_ENVS, 6), 0.05)
    joints = env.view.joints(JOINTS)
    low, high = joints.soft_limits_L2.unbind(-1)
    start = expected = joints.encoder_pos_EL
    for _ in range(6):
        with env.driver.scope("actions/tip"):
            term(env.view, action)
        step = term.step(env.view, action, expected)
        expected = (expected + step).clamp(start - 0.03, start + 0.03).clamp(low, high)
        found = env.view.joint_pos_target_EL[:, joints.index]
        assert torch.allclose(found, expected, atol=1e-6)
    # The robot has not moved: the targets are as far ahead as they may be.
    assert float((found - start).abs().max()) == pytest.approx(0.03, abs=1e-6)


def test_the_tip_goes_where_it_is_asked_to():
    env = env_of(scale=0.02, clip=(-1.0, 1.0))
    root_E = env.reset()
    assert env.action_spec.shape == (NUM_ENVS, 3)
    assert env.action_spec.space.low.min() == -1.0
    goal = torch.tensor([0.35, 0.1, 0.25])
    for _ in range(80):
        away = goal - env.view.site(Arm.tip).pos_EL
        root_E = env.step_and_maybe_reset(root_E.set("action", away / 0.02))[1]
    away = goal - env.view.site(Arm.tip).pos_EL
    assert float(torch.linalg.vector_norm(away, dim=-1).max()) < 0.02
    env.close()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"site": "tp"}, "site.*'tp'.*'tip'"),
        ({"joints": ()}, "joints"),
        ({"damping": 0.0}, "damping=0.0"),
        ({"scale": -1.0}, "scale=-1.0"),
        ({"max_lead": 0.0}, "max_lead=0.0"),
    ],
)
def test_what_cannot_be_is_refused_by_field(env, fields, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(env.cfg.actions["tip"], **fields).size(env.view)
