"""Pushes against Newton's laws and the C engine."""

import math

import mujoco
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.envs import (
    ManagerBasedRlEnv,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    SceneCfg,
)
from tests.envs.probe_env import DT, SUBSTEP_S, puck_cfg
from tests.mdp.bench import FREE_BODY

BRICK = f"""
<mujoco>
  <option timestep="{SUBSTEP_S}" gravity="0 0 -8" integrator="implicitfast"/>
  <worldbody>
    <body name="brick">
      <freejoint name="brick"/>
      <inertial pos="0 0 0" mass="2" diaginertia="0.1 0.2 0.25"/>
      <geom size="0.1" contype="0" conaffinity="0"/>
      <body name="knob"><inertial pos="0 0 0" mass="0.5" diaginertia="0.01 0.01 0.01"/>
        <joint name="knob"/></body>
    </body>
  </worldbody>
  <actuator><motor name="knob" joint="knob"/></actuator>
</mujoco>
"""
LOPSIDED = BRICK.replace('pos="0 0 0" mass="2"', 'pos="0.1 0.05 0" mass="2"')


def brick_env(source=BRICK, **events):
    velocity = {"v": ObservationTermCfg(term=mdp.RootLinVel(frame="world"))}
    return ManagerBasedRlEnv(
        puck_cfg(
            events=events,
            scene=SceneCfg(robots={"brick": MjcfRobot(source=source)}, num_envs=3),
            observations={"actor": ObservationGroupCfg(terms=velocity)},
            actions={"push": mdp.JointEffortAction()},
            rewards={},
            limit=None,
        )
    )


def stepped(env, root_E, steps=1):
    for _ in range(steps):
        root_E = env.step(root_E.set("action", torch.zeros(3, 1)))["next"].clone()
    return root_E


def press(x=0.0, *, every, lasts, **axes):
    """Press along x, unless there are other axes, at intervals and for times in env steps."""
    return mdp.PushByForce(
        body="brick",
        wrench_range=axes or {"x": (x, x)},
        duration_s=(lasts * DT, lasts * DT),
        interval_range_s=(every * DT, every * DT),
    )


def test_a_push_begins_with_the_interval_and_lasts_its_time():
    env = brick_env(push=press(5.0, every=4, lasts=2))
    root_E, speeds = env.reset(), []
    for _ in range(10):
        root_E = stepped(env, root_E)
        speeds.append(float(root_E["obs", "v"][1, 0]))
    # 5 N on 2.5 kg for a step of 20 ms give 0.04 m/s, in steps 4, 5 and 8, 9.
    gained = [round((b - a) / 0.04, 3) for a, b in zip([0.0, *speeds], speeds, strict=False)]
    assert gained == [0, 0, 0, 1, 1, 0, 0, 1, 1, 0]


@pytest.mark.parametrize("steps", [1, 3, 7, 25])
def test_a_push_of_n_steps_lasts_n_steps(steps):
    env = brick_env(push=press(5.0, every=40, lasts=steps))
    root_E = stepped(env, env.reset(), 40 + steps + 3)
    assert float(root_E["obs", "v"][0, 0]) == pytest.approx(0.04 * steps, abs=1e-5)


def test_the_wrench_is_at_the_centre_of_mass_in_the_world_frame_as_in_the_c_engine():
    wrench = (1.0, -2.0, 3.0, 0.1, 0.2, -0.3)
    axes = ("x", "y", "z", "roll", "pitch", "yaw")
    ranges = {axis: (value, value) for axis, value in zip(axes, wrench, strict=True)}
    push = mdp.PushByForce(
        body="brick", wrench_range=ranges, duration_s=(DT, DT), interval_range_s=(DT, DT)
    )
    env = brick_env(LOPSIDED, push=push)
    root_E = env.reset()
    start = torch.tensor([0, 0, 1, math.cos(0.4), 0, math.sin(0.4), 0, 0.3])
    env.world.qpos_EL.copy_(start.expand(3, -1))
    stepped(env, root_E, 5)

    model = mujoco.MjModel.from_xml_string(LOPSIDED)
    data = mujoco.MjData(model)
    data.qpos[:] = start.numpy()
    data.xfrc_applied[model.body("brick").id] = wrench
    mujoco.mj_step(model, data, nstep=20)
    assert env.world.qvel_EL[2].tolist() == pytest.approx(list(data.qvel), abs=1e-5)
    assert env.world.qpos_EL[2].tolist() == pytest.approx(list(data.qpos), abs=1e-5)


def test_two_pushes_on_one_body_add_up_and_leave_nothing():
    env = brick_env(long=press(5.0, every=2, lasts=1), short=press(2.5, every=3, lasts=1))
    root_E, before, gained = env.reset(), 0.0, []
    for _ in range(6):
        root_E = stepped(env, root_E)
        speed = float(root_E["obs", "v"][0, 0])
        gained.append(round((speed - before) / 0.02, 3))
        before = speed
    assert gained == [0, 2, 1, 2, 0, 3]
    stepped(env, root_E)
    assert env.world.xfrc_applied_EL.eq(0.0).all()


def test_a_reset_ends_the_push_of_its_rows_only():
    env = brick_env(push=press(5.0, every=2, lasts=50))
    stepped(env, env.reset(), 3)
    root_E = env.reset(env_ids=[1])
    assert (env.world.xfrc_applied_EL[:, 1, 0] == torch.tensor([5.0, 0.0, 5.0])).all()
    before_E = root_E["obs", "v"][:, 0].clone()
    gained_E = stepped(env, root_E)["obs", "v"][:, 0] - before_E
    torch.testing.assert_close(gained_E, torch.tensor([0.04, 0.0, 0.04]), atol=1e-6, rtol=0)


def test_a_pattern_of_several_bodies_is_refused():
    push = mdp.PushByForce(
        body="b.*|knob", wrench_range={}, duration_s=(1, 1), interval_range_s=(1, 1)
    )
    with pytest.raises(ValueError, match=r"matches \['brick', 'knob'\]: name one of them"):
        brick_env(push=push)


def test_a_jump_reaches_its_height(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0), qvel=(0.5, 0, 0, 0, 0, 0, 0, 0))
    free_body.fire(mdp.Jump(height_range=(0.3, 0.3), interval_range_s=(1.0, 1.0)))
    start_E = free_body.world.subtree_com_EL[:, 1, 2].clone()
    top_E = start_E.clone()
    for _ in range(20):  # it is up after sqrt(2 * 0.3 / 9.81) = 0.247 s
        free_body.step(10)
        top_E = torch.maximum(top_E, free_body.world.subtree_com_EL[:, 1, 2])
    torch.testing.assert_close(top_E - start_E, torch.full((3,), 0.3), atol=5e-3, rtol=0)


def test_a_jump_adds_to_the_velocity_of_its_rows(free_body):
    velocity = torch.tensor([0.5, 0.25, -1.0, 0.1, 0.2, 0.3, 0.0, 0.0])
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0), qvel=velocity)
    free_body.world.gravity_EL.copy_(torch.tensor([0.0, 0.0, -5.0]))
    free_body.fire(
        mdp.Jump(height_range=(0.4, 0.4), interval_range_s=(1.0, 1.0)),
        torch.tensor([True, False, False]),
    )
    assert torch.equal(free_body.world.qvel_EL[1:], velocity.expand(2, 8))
    expected = velocity + torch.tensor([0, 0, math.sqrt(2 * 5.0 * 0.4), 0, 0, 0, 0, 0])
    torch.testing.assert_close(free_body.world.qvel_EL[0], expected)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: press(1.0, every=1, lasts=1, yaww=(0, 1)),
            "wrench_range key 'yaww'.* did you mean 'yaw'",
        ),
        (
            lambda: mdp.PushByForce(body="b", wrench_range={}, duration_s=(1.0, 1.0), mode="reset"),
            "mode='reset': expected 'interval'",
        ),
        (
            lambda: mdp.Jump(height_range=(-0.1, 0.2), interval_range_s=(1.0, 1.0)),
            r"height_range\[0\]=-0.1",
        ),
    ],
)
def test_what_does_not_fit_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_an_unknown_body_is_refused_with_the_near_names(make_bench):
    bench = make_bench(FREE_BODY, 2)
    push = mdp.PushByForce(
        body="trunc", wrench_range={}, duration_s=(1.0, 1.0), interval_range_s=(1.0, 1.0)
    )
    with pytest.raises(ValueError, match="no body matches 'trunc': did you mean 'trunk'"):
        bench.fire(push)


def test_push_adds_to_the_velocity_in_the_world_frame(crowd):
    half = math.pi / 4
    crowd.place(
        qpos=(0, 0, 1, math.cos(half), 0, 0, math.sin(half), 0, 0),
        qvel=(0.5, 0, 0, 0.25, 0, 0, 7, 8),
    )
    before = crowd.world.qvel_EL.clone()
    mask = torch.arange(500) % 2 == 1
    event = mdp.PushByVelocity(
        velocity_range={"x": (1.0, 1.0), "pitch": (2.0, 2.0)}, interval_range_s=(1.0, 3.0)
    )
    crowd.fire(event, mask)
    # A spin about world y is one about x of the body, which is turned by 90 degrees.
    kick = torch.tensor([1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0])
    torch.testing.assert_close(crowd.world.qvel_EL[mask], before[mask] + kick, atol=1e-5, rtol=0)
    assert torch.equal(crowd.world.qvel_EL[~mask], before[~mask])


def test_two_pushes_of_one_moment_add_up(crowd):
    event = mdp.PushByVelocity(velocity_range={"yaw": (1.0, 1.0)}, interval_range_s=(1.0, 3.0))
    crowd.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0))
    for scope in ("events/first", "events/second"):
        with crowd.driver.scope(scope):
            event(crowd.view, crowd.everybody_E)
    torch.testing.assert_close(crowd.world.qvel_EL[:, 5], torch.full((500,), 2.0))


def test_push_needs_an_interval_and_known_axes():
    with pytest.raises(ValueError, match="interval_range_s"):
        mdp.PushByVelocity(velocity_range={})
    with pytest.raises(ValueError, match=r"velocity_range.*'jaw'.*'yaw'"):
        mdp.PushByVelocity(velocity_range={"jaw": (0.0, 1.0)}, interval_range_s=(1.0, 2.0))
