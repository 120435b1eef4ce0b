"""Exports of policies run on MuJoCo's C engine as they did here, and what is broken in one of them is named."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")
onnx = pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl import envs, mdp  # noqa: E402
from ksim_rl.envs.term import ObservationTerm, RewardTerm  # noqa: E402
from ksim_rl.envs.view import EnvView  # noqa: E402
from ksim_rl.export import export_policy, sim2sim  # noqa: E402
from ksim_rl.export.onnx_file import OPSET  # noqa: E402
from ksim_rl.export.sim2sim import ratio_error  # noqa: E402
from ksim_rl.export.standalone.files import read_arrays  # noqa: E402
from ksim_rl.export.standalone.policy_control import PolicyControl  # noqa: E402
from ksim_rl.export.standalone.runner import Runner  # noqa: E402
from ksim_rl.export.standalone.simulated_robot import SimulatedRobot  # noqa: E402
from ksim_rl.modules import update_normalizers  # noqa: E402
from ksim_rl.trainers.algorithm import make_policy  # noqa: E402
from ksim_rl.trainers.build import build_env  # noqa: E402
from ksim_rl.trainers.run_cfg import RunCfg  # noqa: E402
from ksim_rl.trainers.run_folder import Policy  # noqa: E402
from ksim_rl.transforms import ObservationTermCfg  # noqa: E402
from tests.export.broken_exports import BREAKS, change_json, measured  # noqa: E402

# Of the recorded episodes; the report was written with others.
SEED = 4711


def silent(_: str) -> None:
    """Say nothing."""


def exported(task, folder, *, episodes=4, change=lambda cfg: cfg, seed=SEED):
    """Export a policy that has seen some observations."""
    found = envs.task(task)
    settings = {f.name: getattr(found.training, f.name) for f in dataclasses.fields(found.training)}
    cfg = RunCfg(**settings, task_name=task, task=change(found.cfg()), device="cpu")
    torch.manual_seed(3)
    env = build_env(cfg, num_envs=4, seed=5)
    actor = make_policy(cfg, env)
    with torch.no_grad():
        update_normalizers(env.rollout(20, break_when_any_done=False), actor)
    env.close()
    policy = Policy(cfg=cfg, actor=actor, iteration=0)
    return export_policy(policy, folder, episodes=episodes, seed=seed, note=silent)


def report_of(folder, **options):
    return sim2sim(folder, note=silent, **{"episodes": 2, **options})


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory):
    return exported("cartpole_balance", tmp_path_factory.mktemp("cartpole") / "export")


@pytest.fixture(scope="module")
def quadruped(tmp_path_factory):
    return exported("quadruped_velocity_delayed", tmp_path_factory.mktemp("quadruped") / "export")


def test_cartpole_earns_the_same_from_the_folder_alone(cartpole):
    report = report_of(cartpole, episodes=4)
    assert report.causes == []
    assert report.return_ratio == pytest.approx(1.0, abs=1e-3)
    assert report.standard_error < 1e-3 and "+- 0.0000 (standard error)" in report.table()
    names = {path.name for path in cartpole.iterdir()}
    assert names >= {"policy.pt2", "robot.xml", "export.json", "runner.py", "README.md"}
    here = str(Path(export_policy.__code__.co_filename).parent).encode()
    for name in ("policy.onnx", "obs.onnx", "scores.onnx"):
        model = onnx.load(cartpole / name)
        onnx.checker.check_model(model)
        assert not any(node.metadata_props for node in model.graph.node), (
            "what the exporter notes is 20 kB"
        )
        stored = {entry.key: entry.value for entry in model.metadata_props}
        assert stored["observation_names"] == "position,velocity"
        assert float(stored["step_dt"]) == pytest.approx(0.01)
        assert [one.version for one in model.opset_import] == [OPSET]
        assert here not in model.SerializeToString()


def test_what_the_c_engine_trained_is_judged_in_other_physics(tmp_path):
    """A reward that is drawn counts on neither side."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Riddle(RewardTerm):
        def __call__(self, view: EnvView) -> torch.Tensor:
            return 1.0 + 0.0 * view.uniform(1)[:, 0]

    def change(cfg):
        sim = dataclasses.replace(cfg.sim, engine="c")
        return dataclasses.replace(cfg, sim=sim, rewards={**cfg.rewards, "riddle": Riddle()})

    folder = exported("cartpole_balance", tmp_path / "export", change=change)
    assert json.loads((folder / "export.json").read_text())["engine"] == "c"
    report = report_of(folder, episodes=4)
    said = "with integrator euler instead of implicitfast, with a time step of 0.005 s instead of 0.01 s"
    assert said in report.table()
    # Single steps equal training's; whole episodes do not.
    assert report.causes == []
    assert report.return_ratio == pytest.approx(1.0, abs=0.02)
    assert report.return_ratio != pytest.approx(1.0, abs=1e-9)
    assert report.left_out == ["rewards.riddle"] and report.ours["reward/riddle"] > 0
    (line,) = [line for line in report.table().splitlines() if line.startswith("return  ")]
    assert line.endswith("  without riddle")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Everything(ObservationTerm):
    """All quantities that an export names."""

    def __call__(self, view: EnvView) -> torch.Tensor:
        root, joints = view.robot, view.joints()
        bodies, sites = view.bodies(".*"), view.sites(".*")
        parts = [
            *(joints.pos_EL, joints.pos_rel_EL, joints.vel_EL, joints.acc_EL, joints.effort_EL),
            *(
                bodies.pos_EN3,
                bodies.quat_EN4,
                bodies.axes_EN33,
                bodies.lin_vel_EN3,
                bodies.ang_vel_EN3,
            ),
            *(bodies.subtree_com_pos_EN3, sites.pos_EN3, sites.axes_EN33, sites.height_EN),
            *(
                sites.lin_vel_EN3,
                sites.lin_vel_of_contacts_EN3,
                root.root_pos_EL,
                root.root_quat_EL,
            ),
            *(
                root.root_height_E,
                root.projected_gravity_EL,
                root.root_lin_vel_b_EL,
                root.root_lin_vel_w_EL,
            ),
            *(root.root_ang_vel_b_EL, root.root_ang_vel_w_EL),
            root.ground_scan(((0.1, 0.0), (0.0, -0.2))).below_EN,
            *(view.default_joint_pos_EL, view.encoder_bias_EL, view.joint_pos_target_EL),
            *(
                view.joint_vel_target_EL,
                view.joint_effort_target_EL,
                view.action_EL,
                view.last_action_EL,
            ),
            *(view.episode_time_E, view.episode_step_E, view.time_out_offset_E, view.terminated_E),
            *(
                view.world.qvel_EL,
                view.world.actuator_force_EL,
                view.world.ctrl_EL,
                view.world.sensordata_EL,
            ),
            *(part for name in view.sensors for part in view.contact(name)),
        ]
        return torch.cat(
            [part.reshape(view.num_envs, -1).to(torch.float32) for part in parts], dim=-1
        )


@pytest.mark.full
def test_all_quantities_are_read_as_here_also_where_default_poses_differ(tmp_path):
    def change(cfg):
        drawn = {"default_pose": mdp.RandomizeDefaultJointPos(ranges=(-0.2, 0.2))}
        actor = cfg.observations["actor"]
        terms = {**actor.terms, "everything": ObservationTermCfg(term=Everything())}
        return dataclasses.replace(
            cfg,
            sim=dataclasses.replace(cfg.sim, engine="c"),
            events={**drawn, **cfg.events},
            observations={**cfg.observations, "actor": dataclasses.replace(actor, terms=terms)},
        )

    folder = exported("quadruped_velocity_flat", tmp_path / "export", change=change)
    runner = Runner(folder)
    # A robot stands in the pose of its model, not in one that world 0 drew.
    stands = runner.model.key_qpos[0][[at for at, _ in runner.joints.values()]]
    np.testing.assert_allclose(runner.meta["joints"]["default_pos"], stands, atol=1e-6)
    assert runner.meta["default_joint_pos"] == runner.meta["joints"]["default_pos"]
    # Each observation of single steps is compared, from the recorded states.
    record = read_arrays(folder / "trace.npz")
    assert np.abs(record["start/default_pos"] - stands).max() > 0.1
    for number in range(2):
        seen = runner.replay(record, number, 0)["obs"]
        ours = record["trace/obs"][number][: len(seen)]
        size = np.maximum(np.abs(ours), 1.0)
        assert (np.abs(seen - ours) / size).max() < 1e-3


# `test_tracing` compares the terms of tasks without an export of each, and cartpole's are compared above.
LONG = (
    "arm_push",
    "arm_reach",
    "cheetah_run",
    "hopper_stand",
    "pendulum_swingup",
    "quadruped_get_up",
    "walker_walk",
)


@pytest.mark.full
@pytest.mark.parametrize("task", LONG)
def test_the_terms_of_a_task_give_the_same_in_the_c_engine(task, tmp_path):
    report = report_of(exported(task, tmp_path / "export"), episodes=4)
    # The cube rests on the table without a sensor that would tell so; the solvers leave it 1e-5 m/s apart.
    assert report.left_out == [] and (report.causes == [] or task == "arm_push")
    compared = [name for name in report.theirs if name.startswith(("reward/", "metric/"))]
    assert len(compared) == len(report.ours.keys() & set(compared)) > 0
    for name in compared:
        assert report.theirs[name] == pytest.approx(report.ours[name], rel=0.02, abs=2e-3), name


def test_the_ratio_has_the_error_of_pairs():
    draws = np.random.default_rng(0)
    ours = 10.0 + 5.0 * draws.standard_normal((2000, 50))
    theirs = 0.9 * ours + draws.standard_normal(ours.shape)
    spread = (theirs.mean(1) / ours.mean(1)).std()
    found = np.mean([ratio_error(*pair) for pair in zip(ours, theirs, strict=True)])
    assert found == pytest.approx(spread, rel=0.1)
    assert np.isnan(ratio_error(ours[0, :1], theirs[0, :1]))


def test_runner_needs_neither_torch_nor_this_library(cartpole, tmp_path):
    for name in ("torch", "ksim_rl", "warp", "tensordict"):
        (tmp_path / f"{name}.py").write_text(f"raise ImportError('{name} is not here')\n")
    done = subprocess.run(
        [sys.executable, "runner.py", "--episodes", "2"],
        cwd=cartpole,
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "return" in done.stdout


def test_the_loop_of_an_export_acts_as_its_runner(cartpole):
    control = PolicyControl(cartpole, json.loads((cartpole / "export.json").read_text()))
    # A motor's control range limits its effort, behind gear and gain.
    (motor,) = range(mujoco.MjModel.from_xml_path(str(cartpole / "robot.xml")).nu)
    robot = SimulatedRobot(cartpole, control.estimated)
    runner = Runner(cartpole)
    most = runner.model.actuator_ctrlrange[motor, 1] * runner.model.actuator_gear[motor, 0]
    assert control.joints.most_effort.tolist() == [most, np.inf]
    for data in (robot.data, runner.data):
        data.qpos[1] = 0.1
    robot.runner.refresh()
    runner.refresh()
    runner.frame = runner.observe(advances=False)
    for _ in range(20):
        robot.write(control(robot.read()))
        runner.step(runner.act())
        assert robot.data.qpos == pytest.approx(runner.data.qpos, abs=1e-6)
    assert abs(runner.data.qpos).min() > 1e-3


@pytest.mark.full
def test_the_loop_of_a_quadruped_acts_as_its_runner(quadruped):
    meta = json.loads((quadruped / "export.json").read_text())
    control = PolicyControl(quadruped, meta)
    runner = Runner(quadruped)
    runner.noisy = False
    # Lags are of the training: a robot has its own.
    for lag in runner.lags:
        lag.most = lag.spec["min"] = lag.spec["max"] = 0
    runner.reset()
    robot = SimulatedRobot(quadruped, control.estimated)
    # Its motors are laws, whose limits no force range has.
    assert np.isfinite(control.joints.most_effort).all()
    for _ in range(20):
        robot.write(control(robot.read()))
        runner.step(runner.act())
        assert control.action == pytest.approx(runner.action, abs=1e-4)
        assert robot.data.qpos == pytest.approx(runner.data.qpos, abs=1e-4)


# -- what is broken is named -------------------------------------------------------------------------------------


@pytest.mark.full
def test_recorded_commands_are_within_the_ranges_of_the_folder(quadruped):
    commands = read_arrays(quadruped / "episodes.npz")["command/twist"].reshape(-1, 3)
    spec = json.loads((quadruped / "export.json").read_text())["commands"]["twist"]
    assert (commands >= np.array(spec["low"]) - 1e-6).all()
    assert (commands <= np.array(spec["high"]) + 1e-6).all() and np.ptp(commands[:, 0]) > 0.1


@pytest.mark.full
def test_an_unbroken_quadruped_differs_in_nothing(quadruped):
    assert report_of(quadruped).causes == []


@pytest.mark.full
@pytest.mark.parametrize("break_it", BREAKS, ids=lambda function: function.__name__)
def test_what_is_broken_is_the_first_cause(quadruped, break_it, tmp_path):
    broken = tmp_path / "broken"
    shutil.copytree(quadruped, broken)
    break_it(broken)
    report = report_of(broken)
    assert report.causes, report.table()
    assert report.causes[0].name == BREAKS[break_it], report.table()


# -- the order of actuators --------------------------------------------------------------------------------------


@pytest.mark.full
def test_ctrl_of_the_exported_robot_is_the_order_of_actions(quadruped):
    meta = json.loads((quadruped / "export.json").read_text())
    model = mujoco.MjModel.from_xml_path(str(quadruped / "robot.xml"))
    driven = [model.joint(int(model.actuator_trnid[i, 0])).name for i in range(model.nu)]
    assert driven == meta["joint_names"]


# -- folders of strangers ----------------------------------------------------------------------------------------


def include(folder):
    (folder / "robot.xml").write_text('<mujoco><include file="/etc/passwd"/></mujoco>')


def mesh_outside(folder):
    (folder / "robot.xml").write_text(
        '<mujoco><asset><mesh file="../../secret.stl"/></asset></mujoco>'
    )


def entities(folder):
    (folder / "robot.xml").write_text('<!DOCTYPE a [<!ENTITY b "c">]><mujoco model="&b;"/>')


def pickled(folder):
    np.savez(folder / "episodes.npz", allow_pickle=True, start=np.array([{"a": 1}], dtype=object))


def unknown(folder):
    change_json(
        folder, lambda meta, _: measured(meta, "joint_vel").update(quantity="__import__", joints=[])
    )


def linked(folder):
    (folder / "policy.onnx").unlink()
    (folder / "policy.onnx").symlink_to("/etc/hostname")


def not_json(folder):
    (folder / "export.json").write_text("{" * 5000)


def no_weights(folder):
    path = folder / "policy.onnx"
    path.write_bytes(path.read_bytes() + b"\x0a\x08location")


@pytest.mark.parametrize(
    "payload",
    [include, mesh_outside, entities, pickled, unknown, linked, not_json, no_weights],
    ids=lambda function: function.__name__,
)
def test_a_strangers_folder_is_refused_in_one_line(cartpole, payload, tmp_path):
    folder = tmp_path / "stranger"
    shutil.copytree(cartpole, folder)
    payload(folder)
    with pytest.raises(ValueError) as refused:
        runner = Runner(folder)
        runner.episode(read_arrays(folder / "episodes.npz"), 0)
    assert not re.search(r"root:|secret.*secret", str(refused.value))


def test_sim2sim_says_what_is_wrong_with_a_folder_and_runs_no_program_in_it(cartpole, tmp_path):
    folder = tmp_path / "stranger"
    shutil.copytree(cartpole, folder)
    (folder / "runner.py").write_text("raise SystemExit('the folder was executed')\n")
    unknown(folder)
    with pytest.raises(ValueError, match="export.json: .*__import__"):
        report_of(folder)
