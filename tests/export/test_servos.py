"""Exports of robots whose actuators have gears, offsets, activations or no names act in the C engine as here."""

import dataclasses
import json

import mujoco
import numpy as np
import pytest
import torch

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl import envs, mdp
from ksim_rl.envs import ManagerBasedRlEnvCfg, MjcfRobot, ObservationGroupCfg, SceneCfg
from ksim_rl.export import export_policy
from ksim_rl.export.standalone.files import read_arrays
from ksim_rl.export.standalone.runner import Runner
from ksim_rl.physics import SimCfg
from ksim_rl.trainers.algorithm import make_policy
from ksim_rl.trainers.build import build_env
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.trainers.run_folder import Policy
from ksim_rl.transforms import ObservationTermCfg

# The actions ask in another order than the actuators stand, which have no names and activations of two of them.
ARM = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="a" axis="0 1 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
      <body pos="0.3 0 0"><joint name="b" axis="0 1 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
        <body pos="0.3 0 0"><joint name="c" axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 0"/>
        </body></body></body>
  </worldbody>
  <actuator>
    <position joint="a" kp="50" kv="5" gear="2" timeconst="0.05" forcerange="-40 40"/>
    <general joint="b" ctrlrange="0 255" gainprm="0.4" biasprm="-51 -50 -5" biastype="affine"/>
    <intvelocity joint="c" kp="20" kv="1" gear="3" actrange="-9 9"/>
  </actuator>
  {keyframe}
</mujoco>
"""
KEYFRAME = '<keyframe><key qpos="0.1234567891 -0.3 0.2"/></keyframe>'


def exported(folder, keyframe):
    group = ObservationGroupCfg(
        terms={
            "pos": ObservationTermCfg(term=mdp.JointPos()),
            "vel": ObservationTermCfg(term=mdp.JointVel()),
        }
    )
    cfg = ManagerBasedRlEnvCfg(
        decimation=4,
        episode_length_s=1.0,
        scene=SceneCfg(robots={"arm": MjcfRobot(source=ARM.format(keyframe=keyframe))}),
        observations={"actor": group, "critic": group},
        actions={
            "turn": mdp.JointVelocityAction(joints="c", scale=0.5),
            "hold": mdp.JointPositionAction(joints=("b", "a"), scale=0.3),
        },
        events={
            "bias": mdp.RandomizeEncoderBias(ranges=(-0.2, 0.2)),
            "joints": mdp.ResetJoints(position_range=(-0.2, 0.2), velocity_range=(-0.1, 0.1)),
        },
        rewards={"effort": mdp.JointEffortL2(weight=-0.01)},
        terminations={"time": mdp.TimeOut()},
        sim=SimCfg(engine="c", timestep=0.005),
    )
    found = envs.task("pendulum_swingup")
    settings = {f.name: getattr(found.training, f.name) for f in dataclasses.fields(found.training)}
    run = RunCfg(**settings, task_name="arm", task=cfg, device="cpu")
    torch.manual_seed(3)
    env = build_env(run, num_envs=2, seed=5)
    actor = make_policy(run, env)
    env.close()
    return export_policy(
        Policy(cfg=run, actor=actor, iteration=0), folder, episodes=2, seed=1, note=lambda _: None
    )


@pytest.fixture(scope="module")
def with_keyframe(tmp_path_factory):
    return exported(tmp_path_factory.mktemp("arm") / "export", KEYFRAME)


@pytest.mark.parametrize(
    "keyframe",
    [
        pytest.param("", id="no keyframe", marks=pytest.mark.full),
        pytest.param(KEYFRAME, id="keyframe"),
    ],
)
def test_an_export_acts_in_the_c_engine_as_here(tmp_path, with_keyframe, keyframe):
    folder = with_keyframe if keyframe else exported(tmp_path / "export", keyframe)
    runner = Runner(folder)
    record = read_arrays(folder / "trace.npz")
    replayed = runner.replay(record, 0, 0)
    assert np.abs(record["start/encoder_bias"]).min() > 1e-3, (
        "servos that know nothing of it show below"
    )
    for name in ("target", "effort", "next_qpos", "next_qvel"):
        ours = record[f"trace/{name}"][0][: len(replayed[name])]
        np.testing.assert_allclose(replayed[name], ours, atol=2e-4, err_msg=name)
    meta = json.loads((folder / "export.json").read_text())
    assert meta["joint_names"] == ["c", "b", "a"]
    assert meta["joint_stiffness"] == pytest.approx([20 * 9, 50, 50 * 4])
    assert meta["joint_damping"] == pytest.approx([9, 5, 5 * 4])
    assert meta["joints"]["limits"]["effort"] == [None, None, 80.0]


def test_a_reset_of_an_export_is_the_default_state(with_keyframe):
    runner = Runner(with_keyframe)
    runner.reset()
    names = [runner.model.actuator(i).name for i in range(3)]
    assert names == ["c", "b", "a"]
    assert runner.data.qpos.tolist() == [0.1234567891, -0.3, 0.2]
    assert runner.data.ctrl.tolist() == pytest.approx(
        [0.0, (51 + 50 * -0.3) / 0.4, 2 * 0.1234567891]
    )
    assert runner.data.act.tolist() == pytest.approx([3 * 0.2, 2 * 0.1234567891])
    mujoco.mj_forward(runner.model, runner.data)
    np.testing.assert_allclose(runner.data.qfrc_actuator, 0.0, atol=1e-6)
