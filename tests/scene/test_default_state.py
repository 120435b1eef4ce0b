"""Resets restore all that the first keyframe holds, and activations follow a pose that events draw."""

import math
from typing import Literal

import mujoco
import numpy as np
import pytest

from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, MjcfRobot, Placement, SceneCfg
from ksim_rl.mdp import ResetJoints
from ksim_rl.physics import SimCfg
from ksim_rl.scene.actuators import PositionActuator
from ksim_rl.scene.scene import build_spec

# Servos of every kind that keeps something: filtered, integrating, a tendon's of 0 to 255, and a mocap body.
ARM = """
<mujoco model="arm">
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody>
    <body name="upper"><joint name="shoulder" axis="0 1 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
      <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
        <body name="finger" pos="0.3 0 0"><joint name="finger" type="slide" axis="0 0 1" range="0 0.04"/>
          <geom type="box" size="0.01 0.01 0.01"/></body></body></body>
    <body name="wheel" pos="0 1 0"><joint name="wheel" axis="0 1 0"/><geom size="0.05"/></body>
    <body name="ball" pos="0 2 1"><freejoint/><geom size="0.05"/></body>
    <body name="goal" mocap="true" pos="1 0 0"><geom size="0.02" contype="0" conaffinity="0"/></body>
  </worldbody>
  <tendon><fixed name="split"><joint joint="finger" coef="1"/></fixed></tendon>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="30" kv="3" timeconst="0.1"/>
    <intvelocity name="elbow" joint="elbow" kp="20" actrange="-3 3"/>
    <general name="grip" tendon="split" ctrlrange="0 255" gainprm="0.016" biasprm="0 -100 -2" biastype="affine"/>
    <motor name="wheel" joint="wheel" gear="0.001"/>
  </actuator>
  <keyframe>{keys}</keyframe>
</mujoco>
"""
CUBE = """<mujoco><worldbody><body name="cube"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
BALL = "0.1 0.2 0.3 1 0 0 0"
FULL = f"""<key name="home" time="0.5" qpos="0.7 -0.4 0.03 0.1 {BALL}" qvel="0.5 0 0 0.2 1 2 3 0.1 0.2 0.3"
  ctrl="0.8 0.25 255 0.6" act="0.75 -0.35" mpos="0.4 0.5 0.6" mquat="0 1 0 0"/>"""
SILENT = f'<key name="home" qpos="0.7 -0.4 0.03 0.1 {BALL}"/>'


def make(
    keys: str = FULL, *, engine: Literal["warp", "c"] = "c", scene: SceneCfg | None = None, **fields
) -> ManagerBasedRlEnv:
    scene = scene or SceneCfg(robots={"arm": MjcfRobot(source=ARM.format(keys=keys))}, num_envs=3)
    blank = {"observations": {}, "rewards": {}, "terminations": {}, "actions": {}}
    sim = SimCfg(engine=engine, timestep=0.002)
    return ManagerBasedRlEnv(
        ManagerBasedRlEnvCfg(decimation=1, scene=scene, sim=sim, **{**blank, **fields})
    )


def state_of(env: ManagerBasedRlEnv, row: int) -> dict[str, np.ndarray]:
    world = env.world
    names = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat")
    return {name: world.view(name)[row].numpy().astype(np.float64) for name in names}


def assert_at(env: ManagerBasedRlEnv, row: int, data: mujoco.MjData) -> None:
    for name, value in state_of(env, row).items():
        np.testing.assert_allclose(value, getattr(data, name), rtol=2e-7, atol=1e-7, err_msg=name)
    assert float(env.world.time_E[row]) == data.time


@pytest.mark.parametrize("engine", ["c", "warp"])
def test_a_reset_restores_all_that_the_keyframe_holds_and_goes_on_as_the_c_engine(engine):
    env = make(engine=engine)
    model = mujoco.MjModel.from_xml_string(ARM.format(keys=FULL))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    env.reset()
    assert_at(env, 0, data)
    for _ in range(50):
        env.world.step()
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(env.world.qpos_EL[1].numpy(), data.qpos, atol=2e-5)
    np.testing.assert_allclose(env.world.act_EL[1].numpy(), data.act, atol=2e-5)


def test_a_reset_restores_the_rows_of_its_mask_only():
    env = make()
    env.reset()
    for _ in range(5):
        env.world.step()
    env.world.ctrl_EL.fill_(0.125)
    env.world.view("mocap_pos").fill_(9.0)
    moved = state_of(env, 1)
    env.reset(env_ids=[0, 2])
    data = mujoco.MjData(env.world.mj_model)
    mujoco.mj_resetDataKeyframe(env.world.mj_model, data, 0)
    assert_at(env, 0, data)
    assert_at(env, 2, data)
    for name, value in state_of(env, 1).items():
        np.testing.assert_array_equal(value, moved[name], err_msg=name)


def test_what_joints_are_asked_for_is_what_the_keyframes_controls_say():
    env = make()
    env.reset()
    view = env.view
    names = view.joints().names
    shoulder, elbow, wheel = (names.index(name) for name in ("shoulder", "elbow", "wheel"))
    assert float(view.joint_pos_target_EL[0, shoulder]) == pytest.approx(0.8)
    assert float(view.joint_vel_target_EL[0, elbow]) == pytest.approx(0.25)
    assert float(view.joint_effort_target_EL[0, wheel]) == pytest.approx(0.6)


def test_a_keyframe_without_controls_is_held_by_its_servos():
    env = make(SILENT)
    env.reset()
    state = state_of(env, 0)
    assert state["ctrl"].tolist() == pytest.approx([0.7, 0.0, 0.0, 0.0])
    assert state["act"].tolist() == pytest.approx([0.7, -0.4])
    for _ in range(250):
        env.world.step()
    arm = [env.view.joints().names.index(name) for name in ("shoulder", "elbow")]
    np.testing.assert_allclose(env.view.joints().pos_EL[0, arm].numpy(), [0.7, -0.4], atol=2e-3)


def test_without_a_keyframe_servos_hold_the_models_own_pose():
    text = ARM.format(keys="").replace('name="shoulder" axis', 'name="shoulder" ref="20" axis')
    env = make(scene=SceneCfg(robots={"arm": MjcfRobot(source=text)}))
    env.reset()
    assert state_of(env, 0)["act"].tolist() == pytest.approx([math.radians(20.0), 0.0])


@pytest.mark.parametrize("keys", [FULL, SILENT])
def test_activations_follow_a_pose_that_was_drawn(keys):
    env = make(
        keys,
        events={"joints": ResetJoints(joints=("shoulder", "elbow"), position_range=(-0.5, 0.5))},
    )
    env.reset()
    drawn_EK = env.view.joints(("shoulder", "elbow")).pos_EL
    assert drawn_EK.std() > 0.05
    start = np.array([0.75, -0.35]) if keys == FULL else np.array([0.7, -0.4])
    expected_EK = start + drawn_EK.numpy() - [0.7, -0.4]
    np.testing.assert_allclose(env.world.act_EL.numpy(), expected_EK, atol=1e-6)


def test_activations_stay_in_their_range():
    text = ARM.format(keys=SILENT).replace('actrange="-3 3"', 'actrange="-0.5 0.5"')
    scene = SceneCfg(robots={"arm": MjcfRobot(source=text)}, num_envs=3)
    env = make(
        scene=scene, events={"joints": ResetJoints(joints="elbow", position_range=(-0.4, -0.3))}
    )
    env.reset()
    np.testing.assert_allclose(env.world.act_EL[:, 1].numpy(), [-0.5] * 3)


def test_entities_that_no_event_moves_start_at_the_keyframe():
    env = make(events={"joints": ResetJoints(joints="shoulder")})
    env.reset()
    np.testing.assert_allclose(
        env.world.qpos_EL[0, 4:].numpy(), [0.1, 0.2, 0.3, 1, 0, 0, 0], rtol=1e-6
    )
    np.testing.assert_allclose(
        env.world.qvel_EL[0, 4:].numpy(), [1, 2, 3, 0.1, 0.2, 0.3], rtol=1e-6
    )


def test_a_joined_scene_restores_the_keyframe_of_each_part():
    arm = MjcfRobot(source=ARM.format(keys=FULL))
    cube = MjcfRobot(source=CUBE)
    turn = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # a quarter about z: x becomes y
    scene = SceneCfg(
        robots={"cube": cube, "left": arm, "right": arm},
        placements={"right": Placement(pos=(5.0, 0.0, 0.0), quat=turn)},
    )
    env = make(scene=scene)
    env.reset()
    state = state_of(env, 0)
    assert state["ctrl"].tolist() == pytest.approx([0.8, 0.25, 255, 0.6] * 2)
    assert state["act"].tolist() == pytest.approx([0.75, -0.35] * 2)
    np.testing.assert_allclose(state["mocap_pos"], [[0.4, 0.5, 0.6], [4.5, 0.4, 0.6]], atol=1e-6)
    np.testing.assert_allclose(state["mocap_quat"][1], [0.0, turn[0], turn[3], 0.0], atol=1e-6)
    own, moved = np.split(state["qvel"][6:], 2)
    np.testing.assert_allclose(own, [0.5, 0, 0, 0.2, 1, 2, 3, 0.1, 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(moved, [0.5, 0, 0, 0.2, -2, 1, 3, 0.1, 0.2, 0.3], atol=1e-6)


def test_actuators_of_ours_hold_the_pose_and_the_models_others_keep_their_controls():
    servo = PositionActuator(joints="shoulder", stiffness=30.0, damping=3.0)
    robot = MjcfRobot(source=ARM.format(keys=FULL), actuators=(servo,))
    model = build_spec(SceneCfg(robots={"arm": robot})).compile()
    assert [model.actuator(i).name for i in range(4)] == ["elbow", "grip", "wheel", "shoulder"]
    assert model.key_ctrl[0].tolist() == [0.25, 255.0, 0.6, 0.7]
    assert model.key_act[0].tolist() == [-0.35]
