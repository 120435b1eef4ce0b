"""Worlds that blow up: what is saved, what the replay says, and what the others notice (nothing)."""

import dataclasses
import os

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import (
    NanGuardCfg,
    SimCfg,
    World,
    load_model,
)
from ksim_rl.physics.nan_guard import failures as nan_file
from ksim_rl.physics.nan_guard import replay

HISTORY, SUBSTEPS = 5, 4
SLEDS = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body name="heavy"><joint name="heavy" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body>
    <body name="light" pos="0 1 0">
      <joint name="light" type="slide" axis="1 0 0"/><geom size="0.1" mass="1e-6"/>
    </body>
    <body name="ball" pos="0 2 0"><freejoint name="ball"/><geom size="0.1" mass="1"/></body>
  </worldbody>
  <actuator><motor name="heavy" joint="heavy"/><motor name="light" joint="light" gear="1e25"/></actuator>
</mujoco>
"""
"""Bodies that never touch: a = F / m, exactly."""
LIGHT, HEAVY = 1, 0


def sleds(tmp_path, *, num_envs=3, guarded=True, max_files=4, **kwargs) -> World:
    guard = NanGuardCfg(folder=str(tmp_path / "failures"), history=HISTORY, max_files=max_files)
    return World(
        load_model(SLEDS),
        num_envs=num_envs,
        sim=SimCfg(nan_guard=guard if guarded else None),
        **kwargs,
    )


def push(world: World, row: int, light: float, steps: int = 1) -> None:
    """Step with 1 N on each heavy sled, and a force on one world's light one."""
    world.ctrl_EL[:, HEAVY] = 1.0
    world.ctrl_EL[:, LIGHT] = 0.0
    world.ctrl_EL[row, LIGHT] = light
    for _ in range(steps):
        world.step(SUBSTEPS)


def test_a_failed_world_is_saved_with_the_states_that_led_there(tmp_path):
    world = sleds(tmp_path)
    push(world, row=1, light=0.0, steps=2)
    assert world.nan_report().ok
    # Geared to 1e34 N, on a microgram: no float32 holds the acceleration.
    push(world, row=1, light=1e9)
    report = world.nan_report()
    assert report.worlds == (1,) and len(report.files) == 1 and not report.ok
    assert (
        str(report.files[0]) in report.messages[0]
        and "ksim_rl.physics.nan_guard.replay" in report.messages[0]
    )

    failure = nan_file.read(report.files[0])
    # It broke in the first substep of the third step; the ring holds the four before it as well.
    assert failure.world == 1 and failure.substep == 2 * SUBSTEPS + 1
    times = np.arange(failure.substep - HISTORY, failure.substep) * 0.01
    np.testing.assert_allclose(failure.states["time"][:, 0], times, atol=1e-6)
    # 1 N on 2 kg.
    np.testing.assert_allclose(failure.states["qvel"][:, HEAVY], times / 2, atol=1e-6)
    assert failure.states["ctrl"][-1].tolist() == [1.0, np.float32(1e9)]
    assert failure.states["ctrl"][-2].tolist() == [1.0, 0.0]
    assert not np.isfinite(failure.reached["qvel"][LIGHT])
    assert np.isfinite(failure.states["qpos"]).all() and np.isfinite(failure.states["qvel"]).all()


def test_the_replay_names_the_step_and_the_dof(tmp_path, capsys):
    world = sleds(tmp_path)
    push(world, row=2, light=0.0, steps=2)
    push(world, row=2, light=1e9)
    (path,) = world.nan_report().files
    failure = nan_file.read(path)
    found = replay.replay(failure)
    assert replay.dof_name(failure.mj_model, found.first) == "light"
    assert not found.was_broken_before and found.breaks_on_c
    assert found.substeps[-1].warnings == ("bad qacc",) and all(
        not s.warnings for s in found.substeps[:-1]
    )
    acceleration, dof = found.substeps[-1].acceleration
    assert acceleration == pytest.approx(1e40, rel=1e-5) and dof == LIGHT
    assert all(substep.deviation < 1e-6 for substep in found.substeps[:-1]), (
        "C and Warp agree until then"
    )
    speed = 0.5 * found.substeps[-2].time  # of 2 kg under 1 N
    assert found.substeps[-2].energy == pytest.approx(0.5 * 2.0 * speed**2, rel=1e-4)

    assert replay.main([str(path)]) == 0
    said = capsys.readouterr().out
    assert "world 2: its last 5 of 9 substeps" in said and "bad qacc" in said
    assert (
        "First: light. Not finite after substep 0 on Warp: " in said
        and "The C engine breaks" in said
    )


def test_a_control_beyond_all_bounds_is_named(tmp_path):
    world = sleds(tmp_path)
    push(world, row=0, light=1e20)
    failure = nan_file.read(world.nan_report().files[0])
    found = replay.replay(failure)
    assert replay.dof_name(failure.mj_model, found.first) == "light"
    assert found.substeps[-1].warnings == ("bad ctrl",)
    assert "The control of actuator 'light' is 1e+20." in replay.describe(failure, found)


def test_other_worlds_and_the_physics_do_not_notice(tmp_path):
    guarded, plain = sleds(tmp_path), sleds(tmp_path, guarded=False)
    for world in (guarded, plain):
        push(world, row=1, light=1e9, steps=3)
    for row in (0, 2):
        assert torch.equal(guarded.qpos_EL[row], plain.qpos_EL[row])
        assert torch.equal(guarded.qvel_EL[row], plain.qvel_EL[row])
    assert plain.nan_report().ok and plain.nan_report().messages == ()


def test_a_world_is_watched_again_after_the_report(tmp_path):
    world = sleds(tmp_path)
    for _ in range(2):
        push(world, row=0, light=1e9)
        assert world.nan_report().worlds == (0,)
        assert world.nan_report().ok, "said once"
        world.reset(torch.tensor([True, False, False]))
        push(world, row=0, light=0.0)
        assert world.nan_report().ok


def test_what_a_reset_changes_after_the_failure_is_not_what_is_saved(tmp_path):
    world = sleds(tmp_path, per_world_fields=("dof_damping",))
    world.field("dof_damping")[1, HEAVY] = 7.0
    push(world, row=1, light=1e9)
    world.reset(torch.tensor([False, True, False]))
    world.field("dof_damping")[1, HEAVY] = 9.0
    push(world, row=1, light=0.0, steps=3)
    (path,) = world.nan_report().files
    failure = nan_file.read(path)
    assert failure.fields["dof_damping"][HEAVY] == 7.0
    # With damping 7 N s/m and 1 N the heavy sled decelerates from rest: v = dt F / (m + dt c), implicitly.
    found = replay.replay(failure)
    assert failure.mj_model.dof_damping[HEAVY] == 7.0 and found.substeps[0].deviation > 1e30


def test_a_state_that_was_written_as_nan_is_said_to_be_written(tmp_path):
    world = sleds(tmp_path)
    push(world, row=0, light=0.0)
    world.qpos_EL[2, 3] = float("nan")  # y of the ball: qpos holds heavy, light, x, y
    push(world, row=0, light=0.0)
    failure = nan_file.read(world.nan_report().files[0])
    found = replay.replay(failure)
    assert found.was_broken_before
    assert replay.dof_name(failure.mj_model, found.first).startswith("ball[")
    assert "First: ball[0], before substep 0 already" in replay.describe(failure, found)


def test_no_more_than_max_files_are_written_and_the_rest_is_counted(tmp_path):
    world = sleds(tmp_path, max_files=1)
    world.ctrl_EL[:, LIGHT] = 1e9
    world.step(SUBSTEPS)
    report = world.nan_report()
    assert report.worlds == (0, 1, 2) and len(report.files) == 1
    assert [path.name for path in (tmp_path / "failures").iterdir()] == [report.files[0].name]


def test_closing_writes_what_was_not_read(tmp_path):
    world = sleds(tmp_path)
    push(world, row=1, light=1e9)
    world.close()
    assert len(list((tmp_path / "failures").iterdir())) == 1


def test_it_watches_substeps_with_hooks_too(tmp_path):
    world = sleds(tmp_path)
    calls = []

    def motor():
        calls.append(None)
        world.ctrl_EL[1, LIGHT] = 1e9 if len(calls) == 3 else 0.0

    world.step(SUBSTEPS, before=[motor])
    failure = nan_file.read(world.nan_report().files[0])
    assert failure.substep == 3 and failure.states["ctrl"][-1, LIGHT] == np.float32(1e9)
    assert failure.states["ctrl"][-2, LIGHT] == 0.0


def test_a_folder_that_cannot_be_written_does_not_end_the_run(tmp_path):
    world = sleds(tmp_path)
    push(world, row=1, light=1e9)
    (tmp_path / "failures").rmdir()
    report = world.nan_report()
    assert (
        report.worlds == (1,) and report.files == () and "could not be saved" in report.messages[0]
    )


@pytest.mark.parametrize("content", [b"", b"not a tensor file", b"\x10\0\0\0\0\0\0\0{}"])
def test_other_files_are_refused(tmp_path, content, capsys):
    path = tmp_path / "file"
    path.write_bytes(content)
    assert replay.main([str(path)]) == 1
    assert "not a file of the NaN guard" in capsys.readouterr().err


@pytest.fixture(scope="module")
def failure_file(tmp_path_factory):
    world = sleds(tmp_path_factory.mktemp("run"))
    push(world, row=1, light=1e9)
    return world.nan_report().files[0]


WRONG = {
    "a world below zero": ("world=-1", lambda failure: {"world": -1}),
    "a counter that is none": ("substep=True", lambda failure: {"substep": True}),
    "more substeps than there were": (
        "1 substeps are kept of 0|substep=0",
        lambda failure: {"substep": 0},
    ),
    "no substeps": (
        "0 substeps are kept",
        lambda failure: {"states": {name: rows[:0] for name, rows in failure.states.items()}},
    ),
    "a state of another model": (
        r"state/qpos is float32 \(1, 8\): expected float32 \(1, 9\)",
        lambda failure: {"states": {**failure.states, "qpos": failure.states["qpos"][:, :-1]}},
    ),
    "states of other lengths": (
        "state/ctrl",
        lambda failure: {
            "states": {**failure.states, "ctrl": np.repeat(failure.states["ctrl"], 2, axis=0)}
        },
    ),
    "another dtype": (
        "state/ctrl is float64",
        lambda failure: {
            "states": {**failure.states, "ctrl": failure.states["ctrl"].astype(np.float64)}
        },
    ),
    "a state that no substep has": (
        "expected .*it has .*state/odd",
        lambda failure: {"states": {**failure.states, "odd": failure.states["time"]}},
    ),
    "no end": (
        "expected .*reached/qvel",
        lambda failure: {"reached": {"qpos": failure.reached["qpos"]}},
    ),
    "no positions": (
        "'qpos' is missing",
        lambda failure: {"states": {"time": failure.states["time"]}},
    ),
    "a field that no world has": (
        "field/nq, float32",
        lambda failure: {"fields": {"nq": np.zeros(1, np.float32)}},
    ),
    "a field of another size": (
        "field/body_mass has 7 numbers: its model has",
        lambda failure: {"fields": {"body_mass": np.ones(7, np.float32)}},
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_values_that_no_failure_has_are_refused_by_name(failure_file, tmp_path, wrong):
    message, change = WRONG[wrong]
    failure = nan_file.read(failure_file)
    nan_file.write(tmp_path / "file", dataclasses.replace(failure, **change(failure)))
    with pytest.raises(
        ValueError, match=f"file: {message}" if message[0].isalpha() else message
    ) as refused:
        nan_file.read(tmp_path / "file")
    assert "\n" not in str(refused.value)


def test_a_file_that_was_damaged_is_refused(failure_file, tmp_path):
    whole, path = failure_file.read_bytes(), tmp_path / "file"
    for place in range(len(whole) // 3, len(whole), len(whole) // 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(ValueError, match="file: damaged"):
            nan_file.read(path)
        path.write_bytes(whole[:place])
        with pytest.raises(ValueError, match="file: damaged"):
            nan_file.read(path)


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="it is no regular file"):
        nan_file.read(tmp_path / "pipe")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"folder": ""}, "folder=''"),
        ({"folder": "x", "history": 0}, "history=0"),
        ({"folder": "x", "max_files": 1.5}, "max_files=1.5"),
    ],
)
def test_settings_out_of_range_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        NanGuardCfg(**fields)


def test_the_models_own_file_is_not_pickle(tmp_path):
    world = sleds(tmp_path)
    push(world, row=1, light=1e9)
    (path,) = world.nan_report().files
    data = path.read_bytes()
    header = int.from_bytes(data[:8], "little")
    assert data[8 : 8 + header].strip().startswith(b"{"), (
        "safetensors: a JSON header, then plain numbers"
    )
    assert isinstance(nan_file.read(path).mj_model, mujoco.MjModel)
