"""Exported folders of strangers: each function makes one of a whole folder, and `figures` runs `sim2sim` on them."""

import contextlib
import io
import json
import os
import shutil
import signal
import zipfile

import numpy as np

from ksim_rl.cli import main

SECONDS = 120


def change_json(folder, edit):
    path = folder / "export.json"
    meta = json.loads(path.read_text())
    edit(meta)
    path.write_text(json.dumps(meta))


def change_record(folder, **arrays):
    path = folder / "episodes.npz"
    with np.load(path) as file:
        kept = {name: file[name] for name in file.files}
    added = {name.replace("__", "/"): value for name, value in arrays.items()}
    np.savez(
        path, **{name: value for name, value in {**kept, **added}.items() if value is not None}
    )


def bodies_of_geoms(folder):
    change_record(folder, start__model__geom_bodyid=np.full((4, 4), 2**30, np.int32))


def addresses_of_joints(folder):
    change_record(folder, start__model__jnt_qposadr=np.full((4, 2), -(2**30), np.int32))


def addresses_of_joints_as_floats(folder):
    change_record(folder, start__model__jnt_qposadr=np.full((4, 2), 1e9))


def sizes_of_the_model(folder):
    change_record(folder, start__model__nbody=np.full((4, 1), 10**6))


def pictures_of_other_meshes(folder):
    change_record(folder, start__model__geom_dataid=np.full((4, 4), 77, np.int32))


def methods(folder):
    change_record(folder, start__model____init__=np.zeros((4, 1)))


def mass_of_whole_numbers(folder):
    change_record(folder, start__model__body_mass=np.ones((4, 3), np.int64))


def mass_of_another_shape(folder):
    change_record(folder, start__model__body_mass=np.ones((4, 4000)))


def mass_that_is_infinite(folder):
    change_record(folder, start__model__body_mass=np.full((4, 3), np.inf))


def position_that_is_nan(folder):
    change_record(folder, start__qpos=np.full((4, 2), np.nan))


def position_of_another_robot(folder):
    change_record(folder, start__qpos=np.zeros((4, 99)))


def unknown_start(folder):
    change_record(folder, start__mocap=np.zeros((4, 7)))


def no_start(folder):
    change_record(folder, start__qpos=None)


def no_episodes(folder):
    change_record(folder, start__qpos=np.zeros((0, 2)))


def pushes_of_another_robot(folder):
    change_record(folder, pushes=np.ones((3, 99)))


def no_record(folder):
    (folder / "episodes.npz").unlink()


def record_that_is_cut(folder):
    path = folder / "episodes.npz"
    path.write_bytes(path.read_bytes()[:-200])


def record_of_noise(folder):
    (folder / "episodes.npz").write_bytes(np.random.default_rng(0).bytes(4096))


def record_that_is_empty(folder):
    (folder / "episodes.npz").write_bytes(b"")


def record_that_is_a_pipe(folder):
    (folder / "episodes.npz").unlink()
    os.mkfifo(folder / "episodes.npz")


def record_of_terabytes(folder):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    )
    with zipfile.ZipFile(folder / "episodes.npz", "w") as archive:
        archive.writestr("start/qpos.npy", header.getvalue())


def record_of_objects(folder):
    np.savez(folder / "episodes.npz", allow_pickle=True, start=np.array([{"a": 1}], dtype=object))


def no_policy(folder):
    (folder / "policy.onnx").unlink()


def policy_that_is_cut(folder):
    path = folder / "policy.onnx"
    path.write_bytes(path.read_bytes()[:300])


def observations_that_are_cut(folder):
    path = folder / "obs.onnx"
    path.write_bytes(path.read_bytes()[:300])


def observations_of_the_policy(folder):
    shutil.copyfile(folder / "policy.onnx", folder / "obs.onnx")


def scores_without_end(folder):
    change_json(folder, lambda meta: meta["scores"]["measurements"].clear())


def unknown_array(folder):
    node = {"input": "joint_vel", "quantity": "data", "field": "__class__"}
    change_json(folder, lambda meta: meta["obs"]["measurements"].append(node))


def an_older_export(folder):
    change_json(folder, lambda meta: meta.update(format=1))


def mesh_that_is_a_pipe(folder):
    os.mkfifo(folder / "mesh.stl")
    asset = '<mujoco><asset><mesh name="a" file="mesh.stl"/></asset><worldbody><geom type="mesh" mesh="a"/></worldbody>'
    (folder / "robot.xml").write_text(asset + "</mujoco>")


def model_that_is_a_pipe(folder):
    (folder / "robot.xml").unlink()
    os.mkfifo(folder / "robot.xml")


def copies_without_end(folder):
    body = '<replicate count="50000000"><geom size="1"/></replicate>'
    (folder / "robot.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


def ground_without_end(folder):
    field = '<asset><hfield name="a" nrow="60000" ncol="60000" size="1 1 1 1"/></asset>'
    (folder / "robot.xml").write_text(f"<mujoco>{field}</mujoco>")


def another_model(folder):
    (folder / "robot.xml").write_text("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")


def commands_without_end(folder):
    change_json(folder, lambda meta: meta.update(commands={"twist": {"size": 10**12, "kind": "x"}}))


def actions_without_end(folder):
    change_json(folder, lambda meta: meta["policy"].update(num_actions=10**12))


def delay_without_end(folder):
    late = {
        "min": 1,
        "max": 10**12,
        "resample_every": 0,
        "hold_probability": 0.0,
        "shared": None,
        "initial": None,
    }
    change_json(folder, lambda meta: meta["observations"][0].update(delay=late))


def steps_that_are_a_text(folder):
    change_json(folder, lambda meta: meta.update(decimation="fast"))


def no_rewards(folder):
    change_json(folder, lambda meta: meta.pop("rewards"))


def returns_that_are_a_number(folder):
    change_json(folder, lambda meta: meta["ours"].update({"return": 3}))


def returns_of_texts(folder):
    change_json(folder, lambda meta: meta["ours"].update({"return": ["a"] * 4}))


def steps_of_another_robot(folder):
    path = folder / "trace.npz"
    with np.load(path) as file:
        kept = {name: file[name] for name in file.files}
    np.savez(path, **{**kept, "trace/qpos": np.zeros((4, 60, 99))})


def no_steps(folder):
    (folder / "trace.npz").unlink()


STRANGE = {
    name: made
    for name, made in list(globals().items())
    if callable(made)
    and getattr(made, "__module__", "") == __name__
    and not name.startswith("change_")
}


class Hang(BaseException):
    """Ends what takes too long; no command reports it as an error."""


@contextlib.contextmanager
def limit(seconds):
    """Raise `Hang` in what takes longer."""

    def stop(*_):
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def said_of(folder):
    """Run `ksim-rl sim2sim` on a folder; return its exit code, None where it hangs, and what it said on stderr."""
    said = io.StringIO()
    try:
        with (
            limit(SECONDS),
            contextlib.redirect_stderr(said),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            main.main(["sim2sim", str(folder), "--episodes", "2"])
    except Hang:
        return None, said.getvalue()
    except SystemExit as ended:
        return ended.code, said.getvalue()


def figures(whole, place, *, folders):
    """Make strange folders of a whole one, and run `sim2sim` on each; count what is not refused in one line."""
    found = {"folders": 0, "hangs": 0, "not_refused_in_one_line": 0, "whole_one_runs": 0}
    for name, make in list(STRANGE.items())[:: max(1, len(STRANGE) // folders)]:
        folder = place / name
        shutil.copytree(whole, folder)
        make(folder)
        code, said = said_of(folder)
        one_line = said.startswith("ksim-rl: error: ") and said.count("\n") == 1
        found["folders"] += 1
        found["hangs"] += code is None
        found["not_refused_in_one_line"] += code != 2 or not one_line
        if code != 2 or not one_line:
            print(f"{name}: exit code {code}: {said[-400:]}", flush=True)
    found["whole_one_runs"] = float(said_of(whole)[0] == 0)
    return found
