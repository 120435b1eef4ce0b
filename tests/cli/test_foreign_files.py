"""Files that a stranger's config names, its ids, classes and places: read without pickles, or refused."""

import contextlib
import copy
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from ksim_rl.config import class_paths
from ksim_rl.config.plain_data import read_yaml
from ksim_rl.files import arrays, reading
from ksim_rl.files.writing import check_links
from ksim_rl.scene.actuators import nets
from ksim_rl.scene.motions import contents, motion
from ksim_rl.trainers import loggers, run_folder
from tests.cli.payloads import Bomb, call, signs, with_pickles


def pickled_motion(path, code):
    np.savez(path, fps=30.0, qpos=np.array([Bomb(code)], dtype=object), qvel=np.zeros(1))


def pickled_net(path, code):
    torch.save({"x": Bomb(code)}, path)


def with_pickled_arrays(monkeypatch):
    def read(archive, entry):
        with archive.open(entry) as file:
            return np.lib.format.read_array(file, allow_pickle=True)

    monkeypatch.setattr(arrays, "_read_array", read)


DATA_FILES = {
    "motion": (pickled_motion, lambda path: motion._read(path), with_pickled_arrays),
    "actuator net": (pickled_net, lambda path: nets.NetFile(str(path), None), with_pickles),
}


@pytest.mark.parametrize("kind", DATA_FILES)
def test_data_files_hold_no_pickles(kind, place, monkeypatch):
    write, read, without = DATA_FILES[kind]
    path = place.run / "data.npz"
    write(path, place.code)
    with pytest.raises(ValueError, match=r"data\.npz"):
        read(path)
    assert signs(place, "") == []
    without(monkeypatch)
    with contextlib.suppress(ValueError, TypeError, AttributeError):
        read(path)
    assert signs(place, "") != []


@pytest.mark.parametrize("kind", DATA_FILES)
@pytest.mark.parametrize("special", ["pipe", "device", "too long"])
def test_data_files_are_files_of_a_size(kind, special, place, monkeypatch):
    path = place.run / "data.npz"
    if special == "pipe":
        os.mkfifo(path)
    elif special == "device":
        path.symlink_to("/dev/zero")
    else:
        with open(path, "wb") as file:
            file.truncate(reading.MOST_DATA_BYTES + 1)
    with pytest.raises(ValueError, match="no regular file|longer than"):
        DATA_FILES[kind][1](path)


def test_an_archive_that_unpacks_to_more_than_it_may_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(contents, "MOST_DATA_BYTES", 100_000)
    np.savez_compressed(tmp_path / "motion.npz", fps=30.0, qpos=np.zeros(100_000), qvel=np.zeros(1))
    with pytest.raises(ValueError, match="arrays are larger than 100000 bytes"):
        motion._read(tmp_path / "motion.npz")


@pytest.mark.parametrize("text", ["../../elsewhere", "a b", "", "x" * 200])
def test_the_id_of_a_run_is_no_path(tmp_path, text):
    (tmp_path / "wandb").mkdir()
    (tmp_path / "wandb" / "run_id").write_text(text)
    with pytest.raises(ValueError, match=r"run_id"):
        loggers.kept_id(tmp_path)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "ksim_rl.envs.make",
        "ksim_rl.trainers.run_folder.json",
        "pathlib.Path",
    ],
)
def test_targets_are_classes_of_allowed_packages_and_never_functions(target):
    with pytest.raises(ValueError, match="_target_"):
        class_paths.find(target, "x", kind="dataclass", accepts=lambda value: True)


def test_a_place_to_write_to_is_taken_where_the_user_names_it(place, capsys):
    task = copy.deepcopy(place.tree["task"])
    task["sim"]["nan_guard"] = {"folder": "elsewhere"}
    command = place.write_config(task=task)
    assert call([*command, "task.sim.nan_guard.folder=mine"]) == 0, capsys.readouterr().err
    assert Path("mine").is_dir() and not Path("elsewhere").exists()


def test_a_folder_of_ones_own_is_trusted_where_the_user_says_so(place):
    task = copy.deepcopy(place.tree["task"])
    task["sim"]["nan_guard"] = {"folder": str(place.run / "nan")}
    place.write_checkpoint(task=task)
    assert call(["resume", str(place.run)]) == 2
    assert call(["resume", str(place.run), "--trust"]) == 0
    assert (place.run / "nan").is_dir()


@pytest.mark.parametrize("name", ["metrics.csv", ".lock", "tensorboard/events", "checkpoint/file"])
@pytest.mark.parametrize("kind", ["hard link", "pipe"])
def test_a_run_goes_on_only_among_files_of_its_own(place, name, kind, capsys):
    place.write_checkpoint()
    path, precious = place.run / name, place.outside / "precious"
    path.parent.mkdir(exist_ok=True)
    precious.write_text("precious")
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.hardlink_to(precious)
    assert call(["resume", str(place.run)]) == 2
    assert "only files of this folder alone are written" in capsys.readouterr().err
    path.unlink()
    assert call(["resume", str(place.run)]) == 0


def test_policies_are_loaded_without_a_folder_for_failures(place, monkeypatch):
    seen = []
    monkeypatch.setattr(
        run_folder, "build_env", lambda cfg, **_: seen.append(cfg) or pytest.skip.Exception
    )
    task = copy.deepcopy(place.tree["task"])
    task["sim"]["nan_guard"] = {"folder": str(place.outside / "written")}
    place.write_checkpoint({"observation_columns": {}}, task=task)
    with pytest.raises(Exception):  # noqa: B017
        run_folder.load_policy(place.run, device="cpu")
    assert seen[0].task.sim.nan_guard is None


def test_pickles_are_what_this_file_says():
    with pytest.raises(ZeroDivisionError):
        pickle.loads(pickle.dumps(Bomb("1 / 0")))


def test_a_link_to_itself_is_refused_by_name(tmp_path):
    loop = tmp_path / "config.yaml"
    loop.symlink_to(loop)
    # It leads nowhere, and is refused where it is read.
    check_links(tmp_path, below=())
    with pytest.raises(
        ValueError, match=r"config\.yaml: cannot be read: Too many levels of symbolic links"
    ):
        read_yaml(loop)
