"""Conditions change what they say, in the compiled model, and nothing else."""

import dataclasses

import mujoco
import numpy as np
import pytest

from ksim_rl import envs
from ksim_rl.scene.actuators import DCMotorActuator, DelayedActuator, IdealPDActuator
from ksim_rl.scene.names import scalar_joint_ids
from ksim_rl.scene.robots import Cartpole, Cheetah, Quadruped, UnitreeGo2
from ksim_rl.scene.scene import build_spec
from ksim_rl.transfer.changed_robot import changed, entries
from ksim_rl.transfer.conditions import CONDITIONS
from tests.scene.robots.reference import loaded_spec

BY_NAME = {condition.name: condition.change for condition in CONDITIONS}


@pytest.fixture(scope="module")
def quadruped():
    return envs.task("quadruped_velocity_flat").cfg()


def test_names_are_unique_and_the_first_is_what_was_trained(quadruped):
    assert len(BY_NAME) == len(CONDITIONS) >= 28
    assert CONDITIONS[0].change(quadruped) is quadruped


@pytest.mark.parametrize(
    "robot", [Quadruped(), Cartpole(), Cheetah()], ids=lambda robot: robot.name
)
def test_entries_of_a_model_give_its_efforts(robot):
    own, again = robot.spec().compile(), changed(robot, lambda entry: entry).spec().compile()
    rng = np.random.default_rng(0)
    first, second = mujoco.MjData(own), mujoco.MjData(again)
    hinges = [own.joint(i).qposadr[0] for i in scalar_joint_ids(own)]
    for _ in range(5):
        first.qpos[hinges] = second.qpos[hinges] = rng.uniform(-1.0, 1.0, len(hinges))
        first.qvel[:] = second.qvel[:] = rng.uniform(-3.0, 3.0, own.nv)
        control_J = rng.uniform(-3.0, 3.0, own.njnt)
        for model, data in ((own, first), (again, second)):
            # The order of the actuators may be another one.
            data.ctrl[:] = control_J[model.actuator_trnid[:, 0]]
            mujoco.mj_forward(model, data)
        assert second.qfrc_actuator == pytest.approx(first.qfrc_actuator, abs=1e-9)
        assert np.abs(first.qfrc_actuator).max() > 1.0


def test_a_shorter_time_step_leaves_the_env_step_as_long(quadruped):
    found = BY_NAME["time step 1 ms"](quadruped)
    assert found.decimation * found.sim.timestep == pytest.approx(
        quadruped.decimation * quadruped.sim.timestep
    )
    with pytest.raises(ValueError, match="an env step of 0.015 s is no multiple of 0.002 s"):
        BY_NAME["time step 2 ms"](dataclasses.replace(quadruped, decimation=3))


def test_actions_are_late_in_physics_steps(quadruped):
    late = BY_NAME["actions 20 ms late, with jitter"](quadruped).scene.robots["quadruped"].actuators
    assert len(late) == len(entries(Quadruped())) == 12
    # 15 to 25 ms in steps of 5 ms.
    assert {(type(entry), entry.min_lag, entry.max_lag) for entry in late} == {
        (DelayedActuator, 3, 5)
    }


def test_motors_are_of_another_kind_with_the_same_gains():
    cfg = envs.task("go2_velocity_flat").cfg()
    loaded_spec(cfg.scene.robots["go2"])
    motors = BY_NAME["DC motors with back-EMF"](cfg).scene.robots["go2"].actuators
    own = UnitreeGo2().actuators
    assert all(isinstance(motor, DCMotorActuator) for motor in motors)
    assert [(m.stiffness, m.damping, m.effort_limit, m.saturation_effort) for m in motors] == [
        (o.stiffness, o.damping, o.effort_limit, o.effort_limit) for o in own
    ]
    servos = BY_NAME["MuJoCo's servos"](cfg).scene.robots["go2"].spec().compile()
    assert servos.actuator_biasprm[:, 1] == pytest.approx(-30.0)
    ideal = BY_NAME["ideal PD motors"](cfg).scene.robots["go2"].actuators
    assert all(type(motor) is IdealPDActuator for motor in ideal)


def test_motors_without_gains_or_limits_give_less_or_have_less_to_command():
    cartpole = envs.task("cartpole_swingup").cfg()
    own = build_spec(cartpole.scene).compile()
    less = build_spec(BY_NAME["gains 20 % less"](cartpole).scene).compile()
    assert less.actuator_gainprm[0, 0] == pytest.approx(0.8 * own.actuator_gainprm[0, 0])
    empty = build_spec(BY_NAME["a battery that is empty"](cartpole).scene).compile()
    assert empty.actuator_ctrlrange == pytest.approx(0.7 * own.actuator_ctrlrange)
    assert empty.actuator_gear == pytest.approx(own.actuator_gear)


def test_the_ground_rises_along_x(quadruped):
    model = build_spec(BY_NAME["a slope of 5 degrees"](quadruped).scene).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    normal_3 = data.geom("terrain").xmat.reshape(3, 3)[:, 2]
    tilt = np.deg2rad(5.0)
    assert normal_3 == pytest.approx((-np.sin(tilt), 0.0, np.cos(tilt)))


def test_what_a_task_has_none_of_is_refused():
    cartpole = envs.task("cartpole_swingup").cfg()
    for name, words in (
        ("pushes of 0.8 m/s", "no free root"),
        ("twice the noise, and biases", "observations have no noise"),
        ("ideal PD motors", "its GearedMotor has no position servo"),
        ("a slope of 5 degrees", "its ground is no plane"),
        ("friction 0.3", "nothing of it touches anything"),
    ):
        with pytest.raises(ValueError, match=words):
            BY_NAME[name](cartpole)
