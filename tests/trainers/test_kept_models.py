"""A run goes on with the models that it began with: in other folders, after edits, and never in silence."""

import dataclasses
import hashlib
import json
import os
from pathlib import Path

import pytest

from ksim_rl import conf
from ksim_rl.mdp import ResetToMotion
from ksim_rl.objectives import AMPCfg
from ksim_rl.physics import load_model
from ksim_rl.physics.model_files.packing import files_of_model
from ksim_rl.scene.actuators import MLPActuator
from ksim_rl.scene.motions import MotionSet
from ksim_rl.scene.scene import MjcfRobot
from ksim_rl.trainers import RunCfg, kept_models
from ksim_rl.trainers.kept_models import (
    files_read,
    keep_models,
    read_record,
    with_kept_models,
)

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
ROBOT = """
<mujoco>
  <compiler meshdir="../meshes"/>
  <include file="parts/asset.xml"/>
  <worldbody>
    <body name="cart"><joint name="slider" type="slide" axis="1 0 0"/><geom type="mesh" mesh="cart" mass="1"/></body>
  </worldbody>
  <actuator><motor name="slide" joint="slider"/></actuator>
</mujoco>"""
ASSET = '<mujocoinclude><asset><mesh name="cart" file="cart.obj"/></asset></mujocoinclude>'


@pytest.fixture
def robot(tmp_path, monkeypatch) -> Path:
    """Return the relative path of a model of three files, seen from the working directory."""
    home = tmp_path / "home"
    for file, text in (
        ("robot/cart.xml", ROBOT),
        ("robot/parts/asset.xml", ASSET),
        ("meshes/cart.obj", TETRAHEDRON),
    ):
        (home / file).parent.mkdir(parents=True, exist_ok=True)
        (home / file).write_text(text)
    monkeypatch.chdir(home)
    return Path("robot/cart.xml")


def cfg_of(source: str | Path) -> RunCfg:
    """Return a run's config whose robot is a file; the rest of it is of no matter here."""
    cfg = conf.compose(["task=cartpole_swingup"])
    scene = dataclasses.replace(cfg.task.scene, robots={"cart": MjcfRobot(source=str(source))})
    return dataclasses.replace(cfg, task=dataclasses.replace(cfg.task, scene=scene))


def source_of(cfg: RunCfg) -> str:
    """Return the path of the config's robot."""
    robot = cfg.task.scene.robots["cart"]
    assert isinstance(robot, MjcfRobot)
    return robot.source


def kept(robot: Path, folder: Path) -> tuple[RunCfg, list[str]]:
    """Keep the models of a run that begins in `folder`, and return its config and what was said."""
    said: list[str] = []
    cfg = cfg_of(robot)
    keep_models(cfg, folder, note=said.append)
    return cfg, said


@pytest.fixture
def run(tmp_path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    return folder


def test_all_files_are_copied_as_they_are_with_their_hash(robot, run):
    _, said = kept(robot, run)
    record = read_record(run)["robots/cart"]
    copy = run / "models" / record.copy
    assert said == [] and copy.read_text() == ROBOT
    of_copy, of_source = files_of_model(copy), files_of_model(robot)
    assert of_copy is not None and of_source is not None
    assert of_copy.names == of_source.names and len(of_copy.names) == 3
    assert record.sha256 == of_copy.sha256() == of_source.sha256()
    assert record.source == str(robot)
    assert load_model(copy).nmesh == 1


def test_a_model_that_is_as_it_was_is_used_where_it_lies(robot, run):
    cfg, said = kept(robot, run)
    assert with_kept_models(cfg, run, note=said.append) == cfg and said == []


def test_in_another_folder_the_copy_stands_in_for_a_relative_path(
    robot, run, tmp_path, monkeypatch
):
    cfg, said = kept(robot, run)
    monkeypatch.chdir(tmp_path)
    source = source_of(with_kept_models(cfg, run, note=said.append))
    assert Path(source).is_relative_to(run) and load_model(source).nmesh == 1
    assert len(said) == 1 and "no such file: the run's own copy is used" in said[0]


@pytest.mark.parametrize("file", ["robot/cart.xml", "robot/parts/asset.xml", "meshes/cart.obj"])
def test_after_an_edit_of_any_file_the_copy_is_used_and_named(robot, run, file):
    cfg, said = kept(robot, run)
    Path(file).write_text(Path(file).read_text() + "\n")
    source = source_of(with_kept_models(cfg, run, note=said.append))
    assert Path(source).is_relative_to(run)
    assert said == [
        f"task.scene.robots.cart: {robot} has changed since the run began: the run's own copy is used, {source}"
    ]


def test_a_warning_says_so_where_nobody_listens(robot, run):
    cfg, _ = kept(robot, run)
    robot.write_text(ROBOT.replace('mass="1"', 'mass="2"'))
    with pytest.warns(UserWarning, match="has changed since the run began"):
        changed = with_kept_models(cfg, run)
    assert load_model(source_of(changed)).body_mass[1] == 1.0


def test_a_run_that_went_on_with_its_copy_keeps_it_and_may_be_moved(robot, run, tmp_path):
    cfg, said = kept(robot, run)
    before = (run / "models.json").read_text()
    robot.unlink()
    went_on = with_kept_models(cfg, run, note=said.append)
    keep_models(went_on, run, note=said.append)
    assert (run / "models.json").read_text() == before
    run.rename(tmp_path / "moved")
    moved = source_of(with_kept_models(went_on, tmp_path / "moved", note=said.append))
    assert Path(moved).is_relative_to(tmp_path / "moved") and load_model(moved).nmesh == 1


def test_another_model_that_is_asked_for_is_taken(robot, run, tmp_path):
    _, said = kept(robot, run)
    other = tmp_path / "other.xml"
    other.write_text(
        ROBOT.replace('<include file="parts/asset.xml"/>', "").replace(
            'type="mesh" mesh="cart"', 'size="1"'
        )
    )
    cfg = cfg_of(other)
    assert with_kept_models(cfg, run, note=said.append) == cfg and said == []
    keep_models(cfg, run, note=said.append)
    assert read_record(run)["robots/cart"].source == str(other)


def test_above_a_size_only_the_hash_is_kept_and_a_change_is_told(robot, run, monkeypatch):
    monkeypatch.setattr(kept_models, "MOST_KEPT_BYTES", 100)
    cfg, said = kept(robot, run)
    assert len(said) == 1 and "the run keeps only the hash" in said[0]
    assert read_record(run)["robots/cart"].copy == "" and not (run / "models").exists()
    robot.write_text(ROBOT + "\n")
    assert with_kept_models(cfg, run, note=said.append) == cfg
    assert "has changed since the run began, and the run kept its hash alone" in said[1]


def test_a_urdf_file_of_a_package_is_copied_with_what_it_finds_there(run, tmp_path):
    package = tmp_path / "share" / "robots"
    (package / "cart" / "urdf").mkdir(parents=True)
    (package / "cart" / "meshes").mkdir()
    (package / "cart" / "meshes" / "cart.obj").write_text(TETRAHEDRON)
    mesh = '<geometry><mesh filename="package://robots/cart/meshes/cart.obj"/></geometry>'
    urdf = package / "cart" / "urdf" / "cart.urdf"
    urdf.write_text(
        f'<robot name="cart"><link name="cart"><collision>{mesh}</collision></link></robot>'
    )
    (tmp_path / "linked").symlink_to(tmp_path / "share")
    for source in (urdf, tmp_path / "linked" / "robots" / "cart" / "urdf" / "cart.urdf"):
        _, said = kept(source, run)
        record = read_record(run)["robots/cart"]
        assert said == [] and record.copy == "robots_cart/robots/cart/urdf/cart.urdf"
        assert load_model(run / "models" / record.copy).nmesh == 1


def test_files_at_absolute_paths_are_not_copied_and_the_run_says_so(robot, run):
    robot.write_text(ROBOT.replace("../meshes", str(Path("meshes").resolve())))
    _, said = kept(robot, run)
    record = read_record(run)["robots/cart"]
    # They lie in one folder, so that all of it can be copied, and yet the copy would read the old ones.
    assert record.copy == "" and len(said) == 1 and "names files by absolute paths" in said[0]
    assert not (run / "models" / "robots_cart").exists()


def test_a_copy_that_is_damaged_or_reaches_outside_is_refused(robot, run, tmp_path):
    cfg, said = kept(robot, run)
    copy = run / "models" / read_record(run)["robots/cart"].copy
    robot.unlink()
    copy.write_text(ROBOT + "\n")
    with pytest.raises(ValueError, match="damaged: not the model of robots/cart"):
        with_kept_models(cfg, run, note=said.append)
    secret = tmp_path / "secret.xml"
    secret.write_text("<mujocoinclude/>")
    copy.write_text(ROBOT.replace("parts/asset.xml", str(secret)))
    with pytest.raises(ValueError, match="secret.xml, which lies outside of it"):
        with_kept_models(cfg, run, note=said.append)
    copy.unlink()
    copy.symlink_to(secret)
    with pytest.raises(ValueError, match="a link that leads out of the run folder"):
        with_kept_models(cfg, run, note=said.append)


@pytest.mark.parametrize(
    "text", ["[]", "{", '{"robots/cart": 3}', '{"robots/cart": {"source": 1, "sha256": "x"}}']
)
def test_a_strangers_record_is_refused_in_one_line(robot, run, text):
    (run / "models.json").write_text(text)
    with pytest.raises(ValueError, match="no record of a run's models") as caught:
        with_kept_models(cfg_of(robot), run)
    assert "\n" not in str(caught.value)


def test_a_record_that_names_a_path_outside_is_refused(robot, run, tmp_path):
    cfg, _ = kept(robot, run)
    plain = json.loads((run / "models.json").read_text())
    plain["robots/cart"]["copy"] = os.path.relpath(
        tmp_path / "home" / "robot" / "cart.xml", run / "models"
    )
    (run / "models.json").write_text(json.dumps(plain))
    robot.write_text(ROBOT + "\n")
    with pytest.raises(ValueError, match="lies outside of it"):
        with_kept_models(cfg, run, note=lambda _: None)


def test_models_of_no_file_and_of_the_menagerie_are_not_copied(run, tmp_path, monkeypatch):
    _, said = kept(Path(ROBOT), run)
    assert said == [] and not (run / "models.json").exists()
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "scene.xml").write_text("<mujoco/>")
    cfg, said = kept(Path("toy"), run)
    assert said == [] and read_record(run)["robots/cart"].copy == ""
    (tmp_path / "toy" / "scene.xml").write_text("<mujoco />")
    with_kept_models(cfg, run, note=said.append)
    assert "toy has changed since the run began" in said[0]


def test_motions_that_have_changed_are_told(run, tmp_path):
    folder = tmp_path / "clips"
    folder.mkdir()
    for clip in ("bow", "kick"):
        (folder / f"{clip}.npz").write_bytes(clip.encode())
    cfg = conf.compose(["task=cartpole_swingup"])

    def with_motions(source: Path) -> RunCfg:
        chosen = MotionSet(sources=(str(source),), held_out_share=0.5)
        scene = dataclasses.replace(cfg.task.scene, motions={"clips": chosen})
        return dataclasses.replace(cfg, task=dataclasses.replace(cfg.task, scene=scene))

    said: list[str] = []
    keep_models(with_motions(folder), run, note=said.append)
    with_kept_models(with_motions(folder), run, note=said.append)
    assert said == []
    # One clip more, which changes who is held out; then other contents.
    (folder / "reach.npz").write_bytes(b"reach")
    with_kept_models(with_motions(folder), run, note=said.append)
    (folder / "reach.npz").unlink()
    (folder / "kick.npz").write_bytes(b"another")
    with_kept_models(with_motions(folder), run, note=said.append)
    assert len(said) == 2 and set(said) == {
        f"task.scene.motions.clips: the motions of {folder} have changed since the run began: other clips may be held "
        "out than in its training"
    }
    # A resumed run keeps what it began with; other motions were asked for.
    keep_models(with_motions(folder), run, note=said.append)
    with_kept_models(with_motions(folder), run, note=said.append)
    assert len(said) == 3
    with_kept_models(with_motions(folder / "bow.npz"), run, note=said.append)
    assert len(said) == 3


@pytest.mark.parametrize("kind", ["motion of a term", "motions of an objective", "motor"])
def test_files_of_data_that_have_changed_are_told(kind, run, tmp_path):
    file = tmp_path / "data.npz"
    file.write_bytes(b"one")
    cfg = conf.compose(["task=cartpole_swingup"])
    if kind == "motion of a term":
        events = {"start": ResetToMotion(file=str(file))}
        cfg = dataclasses.replace(cfg, task=dataclasses.replace(cfg.task, events=events))
        where = "task.events.start"
    elif kind == "motions of an objective":
        objective = AMPCfg(motions=("walker_walk", str(file)), style_group="actor")
        cfg = dataclasses.replace(cfg, objective=objective)
        where = "objective"
    else:
        motor = MLPActuator(joints=("slide",), file=str(file), effort_limit=1.0)
        robot = MjcfRobot(source=ROBOT, actuators=(motor,))
        scene = dataclasses.replace(cfg.task.scene, robots={"cart": robot})
        cfg = dataclasses.replace(cfg, task=dataclasses.replace(cfg.task, scene=scene))
        where = "task.scene.robots.cart.actuators[0]"
    said: list[str] = []
    keep_models(cfg, run, note=said.append)
    with_kept_models(cfg, run, note=said.append)
    assert said == []
    file.write_bytes(b"another")
    assert with_kept_models(cfg, run, note=said.append) == cfg
    assert said == [
        f"{where}: {file} has changed since the run began: its policy may not fit any more"
    ]


def read_by(source: str | Path) -> tuple[bool, str]:
    """Return whether the model of a config is the user's own, and its hash."""
    (file,) = files_read(cfg_of(source))
    assert file.name == "robots/cart"
    return file.is_own, file.sha256()


@pytest.mark.parametrize("part", ["robot/cart.xml", "robot/parts/asset.xml", "meshes/cart.obj"])
def test_a_table_knows_a_model_by_all_of_its_files(robot, part):
    is_own, before = read_by(robot)
    assert is_own
    # Wherever it lies.
    assert read_by(robot.absolute()) == (True, before)
    text = Path(part).read_text()
    Path(part).write_text(f"{text} ")
    assert read_by(robot)[1] != before
    Path(part).write_text(text)
    assert read_by(robot)[1] == before


def test_a_model_that_is_text_is_no_file_of_ones_own(robot):
    long = ROBOT.replace('<include file="parts/asset.xml"/>', f"<!-- {300 * 'long '} -->")
    is_own, sha256 = read_by(long)
    assert not is_own
    assert sha256 == hashlib.sha256(long.encode()).hexdigest()
    (missing,) = files_read(cfg_of("robot/none.xml"))
    assert missing.is_own
    with pytest.raises(ValueError, match="no such file"):
        missing.sha256()
    (named,) = files_read(cfg_of("unitree_go1"))
    assert not named.is_own
