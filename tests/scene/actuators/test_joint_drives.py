"""All kinds of motor models in one env: its trajectory, its resets, its memory and its config."""

import math
from collections import deque
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from ksim_rl.config.config_tree import from_tree, to_tree
from ksim_rl.envs import (
    EnvView,
    ManagerBasedRlEnv,
    ManagerBasedRlEnvCfg,
    MjcfRobot,
    ObservationGroupCfg,
    ObservationTermCfg,
    PlaneTerrain,
    SceneCfg,
)
from ksim_rl.envs.term import EventTerm
from ksim_rl.mdp import (
    ActuatorAction,
    JointEffortAction,
    JointPos,
    JointPositionAction,
    JointVel,
)
from ksim_rl.scene.actuators import Actuator, IdealPDActuator, PositionActuator
from ksim_rl.testing import count_syncs
from tests.scene.actuators.chain import (
    CHAINS,
    JOINTS,
    MLP_LAGS,
    TIMESTEP,
    feed_forward_module,
    one_of_each,
    recurrent_module,
)
from tests.scene.robots.reference import loaded_spec

E, DECIMATION = 4, 4
COLUMNS = ("wrist", "hip", "knee", "ankle", "neck", "elbow")
"""Action columns stand in another order than joints, and joints in another than actuators."""
CUTOFF_HZ, SCALE = 20.0, 0.8
WEIGHTLESS = CHAINS.replace("<option", '<option gravity="0 0 0"')
REST = np.array([0.1, -0.2, 0.3, -0.1, 0.2, -0.3])


@dataclass(frozen=True, kw_only=True)
class Swing(EventTerm):
    """Start near the rest pose, differently in each row, and with some speed."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        view.write_qpos(mask_E, view.default_qpos_L + view.uniform(6, -0.3, 0.3))
        view.write_qvel(mask_E, view.uniform(6, -4.0, 4.0))


def chain_env(
    actuators: tuple[Actuator, ...], action, source: str = CHAINS, device: str = "cpu", **fields
) -> ManagerBasedRlEnv:
    terms = {"pos": ObservationTermCfg(term=JointPos()), "vel": ObservationTermCfg(term=JointVel())}
    defaults = {
        "decimation": DECIMATION,
        "scene": SceneCfg(
            robots={"chain": MjcfRobot(source=source, actuators=actuators)}, num_envs=E
        ),
        "observations": {"actor": ObservationGroupCfg(terms=terms)},
        "actions": {"joints": action},
        "events": {"swing": Swing()},
        "seed": 5,
    }
    return ManagerBasedRlEnv(ManagerBasedRlEnvCfg(**(defaults | fields)), device=device)


FILTERED = JointPositionAction(joints=COLUMNS, scale=SCALE, cutoff_hz=CUTOFF_HZ)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("nets")


@pytest.fixture(scope="module")
def env(folder):
    return chain_env(one_of_each(folder), FILTERED)


def actions(num_steps: int, seed: int = 0) -> Tensor:
    return 1.5 * torch.randn(num_steps, E, 6, generator=torch.Generator().manual_seed(seed))


def step(env, action_EL: Tensor) -> None:
    env.step(TensorDict({"action": action_EL}, batch_size=[E]))


def run(env, actions_TEL: Tensor) -> Tensor:
    """Step; return the joint states reached, [T, E, 12]."""
    states = []
    for action_EL in actions_TEL:
        step(env, action_EL)
        states.append(torch.cat((env.world.qpos_EL, env.world.qvel_EL), dim=-1))
    return torch.stack(states)


class ByHand:
    """The laws of `one_of_each` as loops over numbers, one row at a time."""

    def __init__(self, lag_ankle: int, lag_neck: int) -> None:
        self.recurrent, self.feed_forward = (
            recurrent_module().double(),
            feed_forward_module().double(),
        )
        self.targets = {"ankle": deque(maxlen=lag_ankle + 1), "neck": deque(maxlen=lag_neck + 1)}
        self.seen_by_lstm: list[list[float]] = []
        self.seen_by_mlp: list[tuple[float, float]] = []

    def controls(
        self, q: dict[str, float], v: dict[str, float], target: dict[str, float]
    ) -> dict[str, float]:
        for name, queue in self.targets.items():
            queue.append(target[name])
        late = {name: queue[0] for name, queue in self.targets.items()}

        def pd(name: str, wanted: float) -> float:
            return 20.0 * (wanted - q[name]) - 0.8 * v[name]

        def limited(value: float, limit: float) -> float:
            return max(-limit, min(limit, value))

        highest = min(4.0, 5.0 * (1.0 - v["hip"] / 6.0))
        lowest = max(-4.0, 5.0 * (-1.0 - v["hip"] / 6.0))
        self.seen_by_lstm.append([target["elbow"] - q["elbow"], 0.1 * v["elbow"]])
        self.seen_by_mlp.append((target["wrist"] - q["wrist"], v["wrist"]))
        last = len(self.seen_by_mlp) - 1
        past = [self.seen_by_mlp[max(0, last - lag)] for lag in MLP_LAGS]
        inputs = [error for error, _ in past] + [velocity for _, velocity in past]
        elbow = float(self.recurrent(torch.tensor([self.seen_by_lstm], dtype=torch.float64))[0, -1])
        return {
            "hip": max(lowest, min(highest, pd("hip", target["hip"]))),
            "knee": limited(pd("knee", target["knee"]), 4.0),
            "neck": limited(pd("neck", late["neck"]), 4.0),
            "ankle": late["ankle"],
            "elbow": limited(8.0 * elbow, 3.0),
            "wrist": limited(
                12.0 * float(self.feed_forward(torch.tensor(inputs, dtype=torch.float64))[0]), 2.5
            ),
        }


def run_by_hand(
    model: mujoco.MjModel, start_L: np.ndarray, lags: tuple[int, int], actions_TL: np.ndarray
) -> tuple[np.ndarray, set[tuple[str, float]]]:
    """Step the C engine with the laws by hand.

    Args:
        start_L: joint positions and velocities, [12].
        lags: of ankle and neck, substeps.
        actions_TL: what `FILTERED` takes, [T, 6].

    Returns:
        The joint states reached, [T, 12], and the size of each control that a law wrote, by joint.
    """
    share = 1.0 - math.exp(-2.0 * math.pi * CUTOFF_HZ * DECIMATION * TIMESTEP)
    by_hand, data = ByHand(*lags), mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start_L[:6], start_L[6:]
    filtered, states, touched = np.zeros(6), [], set()
    for action_L in actions_TL:
        filtered += share * (SCALE * action_L - filtered)
        target = {name: REST[JOINTS.index(name)] + filtered[i] for i, name in enumerate(COLUMNS)}
        for _ in range(DECIMATION):
            q, v = (dict(zip(JOINTS, values, strict=True)) for values in (data.qpos, data.qvel))
            for name, control in by_hand.controls(q, v, target).items():
                data.ctrl[model.actuator(name).id] = control
                touched.add((name, abs(control)))
            mujoco.mj_step(model, data)
        states.append(np.concatenate((data.qpos, data.qvel)))
    return np.stack(states), touched


def test_the_trajectory_is_that_of_the_c_engine_with_the_laws_by_hand(env):
    env.seed(5)
    env.reset()
    buffers = env.view.buffers.by_name()
    ankle_lags, neck_lags = (
        buffer.tolist() for name, buffer in buffers.items() if name.endswith("lag_E")
    )
    start = torch.cat((env.world.qpos_EL, env.world.qvel_EL), dim=-1).double().numpy()
    actions_TEL = actions(6)
    reached_TEL = run(env, actions_TEL)
    touched = set()
    for row in range(E):
        lags, actions_TL = (ankle_lags[row], neck_lags[row]), actions_TEL[:, row].double().numpy()
        expected_TL, touched_here = run_by_hand(env.world.mj_model, start[row], lags, actions_TL)
        np.testing.assert_allclose(reached_TEL[:, row], expected_TL, atol=2e-3, rtol=1e-3)
        np.testing.assert_allclose(reached_TEL[:, row, :6], expected_TL[:, :6], atol=2e-5)
        touched |= touched_here
    limits = {("knee", 4.0), ("hip", 4.0), ("neck", 4.0), ("elbow", 3.0), ("wrist", 2.5)}
    assert limits & touched, "some limit was reached"


def test_a_partial_reset_leaves_the_other_rows_bit_identical(env):
    actions_TEL = actions(8, seed=1)
    others = [0, 2, 3]
    env.seed(6)
    env.reset()
    undisturbed_TEL = run(env, actions_TEL)
    env.seed(6)
    env.reset()
    run(env, actions_TEL[:3])
    before = {name: buffer.clone() for name, buffer in env.view.buffers.by_name().items()}
    env.reset(env_ids=[1])
    for name, buffer in env.view.buffers.by_name().items():
        assert torch.equal(buffer[others], before[name][others]), name
        if "hidden" in name or "cell" in name or "started" in name or "filtered" in name:
            assert before[name][1].any() and not buffer[1].any(), name
    disturbed_TEL = run(env, actions_TEL[3:])
    assert torch.equal(disturbed_TEL[:, others], undisturbed_TEL[3:, others])
    assert not torch.equal(disturbed_TEL[:, 1], undisturbed_TEL[3:, 1])


def test_a_restored_env_goes_on_bit_for_bit(env):
    actions_TEL = actions(6, seed=2)
    env.seed(7)
    env.reset()
    run(env, actions_TEL[:3])
    saved = {name: value.clone() for name, value in env.state_dict().items()}
    expected_TEL = run(env, actions_TEL[3:])
    env.seed(8)
    env.reset()
    run(env, actions_TEL)
    env.load_state_dict(saved)
    assert torch.equal(run(env, actions_TEL[3:]), expected_TEL)


def test_stepping_and_resetting_do_not_sync(env):
    env.reset()
    root_E = env.step_and_maybe_reset(env.rand_action(env.reset()))[1]
    with count_syncs() as syncs:
        env.step_and_maybe_reset(root_E.set("action", torch.ones(E, 6)))
    assert syncs.total == 0, syncs.report()


def test_the_numbers_start_at_those_of_the_config(env):
    for name, joint, value in (
        ("stiffness", "knee", 20.0),
        ("velocity_limit", "hip", 6.0),
        ("effort_limit", "wrist", 2.5),
    ):
        values_E = env.view.actuator_param(name, joint)[:, JOINTS.index(joint)]
        assert values_E.tolist() == [value] * E


def test_controls_that_a_law_writes_are_not_for_actions(folder):
    with pytest.raises(ValueError, match="'elbow' is written by a motor model"):
        chain_env(one_of_each(folder), ActuatorAction(actuators="elbow"))


def test_a_law_that_takes_positions_refuses_efforts(folder):
    with pytest.raises(
        ValueError, match="'elbow' is asked for an effort, but its actuator takes a position"
    ):
        chain_env(one_of_each(folder), JointEffortAction(joints="elbow"))


def test_joints_without_an_action_hold_the_default_pose():
    strong = {"stiffness": 400.0, "damping": 10.0}
    env = chain_env(
        (
            PositionActuator(joints=("hip", "knee", "ankle"), **strong),
            IdealPDActuator(joints=("neck", "elbow"), **strong),
            IdealPDActuator(joints="wrist", stiffness=1.0, damping=0.0),
        ),
        JointPositionAction(joints="wrist"),
        source=WEIGHTLESS,
    )
    env.reset()
    for _ in range(60):
        step(env, torch.zeros(E, 1))
    np.testing.assert_allclose(env.world.qpos_EL[:, :5], np.tile(REST[:5], (E, 1)), atol=0.02)


def test_robots_of_one_scene_have_their_own_entries():
    """One chain is driven by a law, the other by a servo, and a third one by nothing."""
    robots = {
        "law": MjcfRobot(
            source=CHAINS, actuators=(IdealPDActuator(joints="knee", stiffness=3.0, damping=0.0),)
        ),
        "servo": MjcfRobot(
            source=CHAINS, actuators=(PositionActuator(joints="knee", stiffness=3.0),)
        ),
        "none": MjcfRobot(source=CHAINS),
    }
    env = chain_env(
        (),
        JointPositionAction(joints=("servo/knee", "law/knee"), use_default_offset=False),
        scene=SceneCfg(robots=robots, num_envs=E),
        events={},
        decimation=1,
    )
    env.reset()
    knees = env.view.joints(("law/knee", "servo/knee"))
    law, servo = knees.pos_EL[0].tolist()
    step(env, torch.tensor([[0.5, 0.7]]).expand(E, 2).contiguous())
    forces = env.world.actuator_force_EL[0].tolist()
    assert forces == pytest.approx([3.0 * (0.7 - law), 3.0 * (0.5 - servo)], rel=1e-5)


def test_actuators_go_through_a_config_tree(folder):
    robot = MjcfRobot(source="robot.xml", actuators=one_of_each(folder))
    assert from_tree(MjcfRobot, to_tree(robot, MjcfRobot)) == robot


@pytest.mark.full
def test_a_robot_of_plain_torque_motors_stands_on_a_pd_controller():
    """Half a second of the menagerie's go2; without effort its trunk falls to the ground."""
    pd = {"stiffness": 60.0, "damping": 2.0, "armature": 0.01}
    robot = MjcfRobot(
        source="unitree_go2/go2",
        actuators=(
            IdealPDActuator(joints=(".*_hip_joint", ".*_thigh_joint"), effort_limit=23.7, **pd),
            IdealPDActuator(joints=".*_calf_joint", effort_limit=45.43, **pd),
        ),
    )
    loaded_spec(robot)
    heights = {}
    for kind, action in (
        ("held", JointPositionAction(joints=".*")),
        ("limp", JointEffortAction(joints=".*")),
    ):
        scene = SceneCfg(robots={"go2": robot}, terrain=PlaneTerrain(), num_envs=1)
        env = chain_env((), action, scene=scene, events=None)
        if kind == "limp":
            env.view.actuator_param("stiffness").zero_()
        env.reset()
        for _ in range(60):
            env.step(TensorDict({"action": torch.zeros(1, 12)}, batch_size=[1]))
        heights[kind] = env.world.qpos_EL[0, 2].item()
    assert heights["held"] > 0.24, "of 0.27 m in the keyframe"
    assert heights["limp"] < 0.15
