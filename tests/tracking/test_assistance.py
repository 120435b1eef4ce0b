"""Help at the root: its wrench in closed form, its withdrawal, and the motion that a policy writes without it."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from ksim_rl import conf, envs, mdp
from ksim_rl.clips.motion_file import write_motion
from ksim_rl.envs import ObservationGroupCfg, ObservationTermCfg
from ksim_rl.physics import SimCfg
from ksim_rl.scene.scene import MjcfRobot, SceneCfg
from ksim_rl.tracking import terms
from ksim_rl.tracking.assistance import AssistRoot, assisted, rolled_out
from ksim_rl.tracking.starts import StartInMotion

BOX = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="trunk" pos="0 0 0.1">
      <freejoint name="root"/>
      <geom name="trunk" type="box" size="0.1 0.1 0.1" mass="2"/>
      <body name="arm" pos="0 0 0.1">
        <joint name="arm" axis="0 1 0"/>
        <geom type="sphere" size="0.02" mass="0.1" pos="0 0 0.1" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="arm" joint="arm" gear="1" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
FPS = 50.0
FIELDS = {
    "stiffness": 1000.0,
    "damping": 40.0,
    "turn_stiffness": 3.0,
    "turn_damping": 0.3,
    "max_force": 30.0,
    "max_torque": 2.0,
}


@pytest.fixture(scope="module")
def rising(tmp_path_factory):
    """A motion that a box cannot do: it rises by 20 cm within a second, and turns about z."""
    model = mujoco.MjModel.from_xml_string(BOX)
    share_F = np.linspace(0.0, 1.0, 51)
    qpos_FL = np.zeros((51, model.nq))
    qpos_FL[:, 2] = 0.1 + 0.2 * share_F**2 * (3.0 - 2.0 * share_F)
    qpos_FL[:, 3] = np.cos(0.25 * share_F)
    qpos_FL[:, 6] = np.sin(0.25 * share_F)
    path = tmp_path_factory.mktemp("clips") / "rising.npz"
    write_motion(path, model, qpos_FL, FPS)
    return str(path)


def cfg_of(motion, *, assist=None, limit=0.05, engine="c"):
    group = ObservationGroupCfg(terms={"pos": ObservationTermCfg(term=mdp.RootPos())})
    cfg = envs.ManagerBasedRlEnvCfg(
        decimation=4,
        scene=SceneCfg(robots={"box": MjcfRobot(source=BOX)}, num_envs=4),
        sim=SimCfg(engine=engine),
        observations={"actor": group, "critic": group},
        actions={"arm": mdp.JointEffortAction(joints="arm")},
        events={"start": StartInMotion(file=motion, start_range=(0.0, 0.0))},
        rewards={"upright": mdp.Upright(std=1.0, weight=1.0)},
        terminations={
            "finished": mdp.MotionFinished(file=motion),
            "off": terms.OffHeight(file=motion, bodies="trunk", distance=limit),
        },
        metrics={"off": terms.BodyDrift(file=motion, bodies="trunk")},
        episode_length_s=10.0,
    )
    if assist is None:
        return cfg
    return assisted(cfg, assist, begin_step=0, end_step=100)


@pytest.fixture(scope="module")
def helped(rising):
    env = envs.ManagerBasedRlEnv(
        dataclasses.replace(cfg_of(rising, assist=AssistRoot(file=rising, **FIELDS)), seed=0),
        device="cpu",
    )
    yield env
    env.close()


def run(env, steps):
    root_E = env.reset()
    ended = torch.zeros(4, dtype=torch.bool)
    for _ in range(steps):
        stepped_E, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(4, 1)))
        ended |= stepped_E["next", "terminated"][:, 0]
    return ended


def test_a_box_rises_with_help_and_stays_below_without(helped, rising):
    helped.view.level.fill_(0.0)
    assert not run(helped, 40).any()
    assert float(helped.view.root_pos_EL[:, 2].min()) > 0.2
    alone = envs.ManagerBasedRlEnv(cfg_of(rising), device="cpu")
    assert run(alone, 40).all()
    alone.close()


def bounded(vector, most):
    length = np.linalg.norm(vector)
    return vector * min(1.0, most / length)


def test_the_wrench_is_the_bounded_springs_and_dampers(helped):
    run(helped, 3)
    term = helped.cfg.events["assistance"]
    view = helped.view
    rng = np.random.default_rng(0)
    state = rng.uniform(-1.0, 1.0, size=(4, 13))
    quat = state[:, 3:7] / np.linalg.norm(state[:, 3:7], axis=1, keepdims=True)
    everybody = torch.ones(4, dtype=torch.bool)

    def tensor(array):
        return torch.tensor(array, dtype=torch.float32)

    view.robot.write_root_pose(everybody, tensor(0.2 * state[:, :3]), tensor(quat))
    view.robot.write_root_velocity(everybody, tensor(state[:, 7:10]), tensor(state[:, 10:]))
    helped.world.refresh()
    helped.driver.refreshed()
    found = term.wrench(view).numpy()
    # Three env steps of 20 ms after the start of the motion.
    with np.load(term.file) as file:
        wanted, speed = file["qpos"][3], file["qvel"][3]
    capped = 0
    for row in range(4):
        force = 1000.0 * (wanted[:3] - 0.2 * state[row, :3]) + 40.0 * (speed[:3] - state[row, 7:10])
        turn = np.zeros(3)
        # The angle of mju_subQuat, of which the help takes twice the sine of the half.
        mujoco.mju_subQuat(turn, wanted[3:7].astype(float), quat[row])
        angle = np.linalg.norm(turn)
        world = np.zeros(3)
        mujoco.mju_rotVecQuat(world, turn * 2.0 * np.sin(angle / 2) / angle, quat[row])
        torque = 3.0 * world + 0.3 * (speed[3:6] - state[row, 10:])
        expected = np.concatenate((bounded(force, 30.0), bounded(torque, 2.0)))
        capped += np.linalg.norm(force) > 30.0
        assert np.allclose(found[row], expected, atol=2e-3)
    assert capped


def test_help_is_withdrawn_by_the_level_and_is_nothing_at_the_end(helped):
    run(helped, 2)
    term, view = helped.cfg.events["assistance"], helped.view
    body = view.robot.root.id
    everybody = torch.ones(4, dtype=torch.bool)
    pressed = helped.world.xfrc_applied_EL[:, body]
    # Of another push, which stays.
    pressed.add_(1.0)
    before = pressed.clone()
    for level in (0.0, 0.75, 1.0):
        view.level.fill_(level)
        with helped.driver.scope("events/assistance"):
            term(view, everybody)
        own = pressed - 1.0
        assert torch.allclose(own, (1.0 - level) * term.wrench(view), atol=1e-4)
    assert before.isfinite().all() and torch.allclose(pressed, torch.ones(4, 6), atol=1e-5)
    # The curriculum that withdraws it ends at 1.
    assert helped.cfg.curriculum["withdrawal"].end_step == 100


def still():
    return TensorDictModule(
        lambda actor_EL: torch.zeros(*actor_EL.shape[:-1], 1), ["actor"], ["action"]
    )


def run_cfg(task, device="cpu"):
    cfg = conf.compose(["task=walker_track", f"device={device}", "num_envs=4"])
    return dataclasses.replace(cfg, task=task, task_name="box")


@pytest.mark.full
@pytest.mark.parametrize(
    ("device", "engine"), [("cpu", "c"), pytest.param("cuda", "auto", marks=pytest.mark.gpu)]
)
def test_what_a_policy_does_alone_is_a_motion_that_tracking_reads(rising, tmp_path, device, engine):
    help_ = AssistRoot(file=rising, **FIELDS)

    def roll_out(task, trials):
        return rolled_out(run_cfg(task, device), still(), trials=trials, note=pytest.fail)

    found, model = roll_out(cfg_of(rising, assist=help_, limit=1.0, engine=engine), trials=3)
    # Without help the box has stayed on the floor all the while, whatever the motion asks for.
    assert (found.success, found.fps) == (1.0, 50.0) and len(found.qpos_FL) == 50
    assert np.abs(found.qpos_FL[:, 2] - 0.1).max() < 2e-3
    assert found.error == pytest.approx(0.09, abs=0.03)
    path = tmp_path / "alone.npz"
    write_motion(path, model, found.qpos_FL, found.fps)
    again, _ = roll_out(cfg_of(str(path), engine=engine), trials=2)
    assert again.success == 1.0 and again.error < 5e-3


def test_a_policy_that_needs_help_writes_no_reference(rising):
    task = cfg_of(rising, assist=AssistRoot(file=rising, **FIELDS))
    with pytest.raises(ValueError, match="in none of 2 trials.*without help.*0.[0-9]+ s"):
        rolled_out(run_cfg(task), still(), trials=2, note=pytest.fail)
    with pytest.raises(ValueError, match="mode='reset': expected 'step'"):
        AssistRoot(file=rising, mode="reset", **FIELDS)
    with pytest.raises(ValueError, match="max_force=0"):
        AssistRoot(file=rising, **{**FIELDS, "max_force": 0.0})
