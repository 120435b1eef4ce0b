"""What was found goes into a training: as a delay of the actuators, and as ranges to draw from."""

import pytest

from ksim_rl import conf, envs
from ksim_rl.identification.findings import Estimate, Findings
from ksim_rl.identification.training_overrides import (
    left_out,
    net_override,
    overrides,
    time_step,
)
from ksim_rl.scene.actuators import DelayedActuator, MLPActuator
from ksim_rl.scene.robots import Arm, UnitreeGo2
from tests.absent_models import skipped_without_models


def found(robot, names, **left_out):
    numbers = {
        "armature": Estimate(value=0.012, half_width=0.001),
        "damping": Estimate(value=0.002, half_width=0.004),
        "frictionloss": Estimate(value=0.3, half_width=0.02),
        "stiffness": Estimate(value=27.0, half_width=0.5),
        "servo_damping": Estimate(value=1.1, half_width=0.1),
        "torque_constant": Estimate(remark="no efforts were commanded"),
    }
    joints = {name: {**numbers, **left_out} for name in names}
    delay_s = Estimate(value=0.0082, half_width=0.0005)
    return Findings(
        robot=robot, joints=joints, delay_s=delay_s, unexplained=dict.fromkeys(names, 1e-3)
    )


def lines_for_go2(findings):
    """The overrides of Go2's task; its actuators are read from the model of the menagerie."""
    with skipped_without_models():
        return overrides(findings, envs.task("go2_velocity_flat").cfg())


def test_a_training_takes_them():
    names = UnitreeGo2.joint_names
    lines = lines_for_go2(found("go2", names))
    # Words of a shell: `$(cat FILE)` cuts at blanks.
    assert not any(set(line) & set(" \t'\"$") for line in lines)
    cfg = conf.compose(["task=go2_velocity_flat", *lines]).task
    late = cfg.scene.robots["go2"].actuators
    assert [entry.actuator for entry in late] == list(UnitreeGo2().actuators)
    # 8.2 ms are between one and two steps of 5 ms, one delay for the whole bus.
    assert {(type(entry), entry.min_lag, entry.max_lag, entry.lag_group) for entry in late} == {
        (DelayedActuator, 1, 2, "bus")
    }
    events = cfg.events
    assert events["identified_armature"].ranges == dict.fromkeys(names, (0.011, 0.013))
    # No number of a joint is negative.
    assert events["identified_damping"].ranges["FL_calf_joint"] == (0.0, 0.006)
    assert events["identified_gains_FL_calf_joint"].stiffness == (26.5, 27.5)
    assert "push_robot" in events


@pytest.mark.full
def test_an_env_draws_them():
    lines = lines_for_go2(found("go2", UnitreeGo2.joint_names))
    env = envs.make("go2_velocity_flat", num_envs=4, device="cpu", overrides=lines)
    drawn = env.view.field("dof_armature")[:, 6:]
    assert 0.011 <= drawn.min() < drawn.max() <= 0.013
    stiffness = env.view.actuator_param("stiffness")
    assert 26.5 <= stiffness.min() < stiffness.max() <= 27.5
    env.rollout(3)


def test_what_was_not_told_is_left_as_it_was():
    nothing = {
        "stiffness": Estimate(remark="no positions"),
        "damping": Estimate(remark="within the servo"),
    }
    lines = lines_for_go2(found("go2", UnitreeGo2.joint_names, **nothing))
    assert not any("identified_damping" in line for line in lines)
    gains = [line for line in lines if "identified_gains" in line]
    assert len(gains) == 12 and all("stiffness:null" in line for line in gains)


def test_what_no_override_carries_is_said():
    go2 = envs.task("go2_velocity_flat").cfg()
    assert left_out(found("go2", UnitreeGo2.joint_names), go2) == []
    weak = {"torque_constant": Estimate(value=0.8, half_width=0.1)}
    (line,) = left_out(found("go2", ("FL_hip_joint",), **weak), go2)
    assert "FL_hip_joint 0.8" in line
    # Its servos are of the model's own file.
    (line,) = left_out(found("arm", Arm.joints), envs.task("arm_reach").cfg())
    assert "the delay of 8.2 ms" in line


def test_networks_drive_the_robot_of_a_task(tmp_path):
    cfg = envs.task("go2_velocity_flat").cfg()
    entries = [MLPActuator(joints=UnitreeGo2.joint_names, effort_limit=20.0, file="a.safetensors")]
    line = net_override("go2", entries, cfg)
    assert not set(line) & set(" \t'\"$")
    changed = conf.compose(["task=go2_velocity_flat", line]).task
    assert list(changed.scene.robots["go2"].actuators) == entries
    # An arm's servos are its model's own, and so is its time step.
    arm = envs.task("arm_reach").cfg()
    assert net_override("arm", [], arm) == "task.scene.robots.arm.actuators=[]"
    assert time_step(arm) == 0.005
    with pytest.raises(ValueError, match="'a b' cannot stand in words of a shell"):
        net_override("go2", [MLPActuator(joints="a b", file="a")], cfg)
    with pytest.raises(ValueError, match="'cartpole' has no field `actuators`"):
        net_override("cartpole", entries, envs.task("cartpole_balance").cfg())


def test_another_robots_task_is_refused():
    with pytest.raises(ValueError, match="--task: its robots are go1, and none is 'go2'"):
        overrides(found("go2", UnitreeGo2.joint_names), envs.task("go1_velocity_flat").cfg())
