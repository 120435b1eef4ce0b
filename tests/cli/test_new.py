"""`ksim-rl new robot` writes a package around a model, whose task trains and whose own test passes."""

import ast
import sys
import tomllib

import mujoco
import pytest

from ksim_rl.cli import main
from ksim_rl.cli.new import copy_model
from tests.absent_models import skipped_without_models
from tests.docs import guide
from tests.scene.robots.test_analysis import biped

QUICK = "num_envs=16 collector.rollout_length=24 trainer.num_iterations=2 trainer.video=false trainer.eval_episodes=0"


def run(*arguments):
    with pytest.raises(SystemExit) as stopped:
        main.main(list(arguments))
    return stopped.value.code


@pytest.fixture
def work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tin_man.xml").write_text(biped())
    return tmp_path


def test_the_package_has_robot_task_test_and_readme(work, capsys):
    assert run("new", "robot", "tin_man.xml") == 0
    files = {
        path.relative_to(work / "tin_man").as_posix() for path in (work / "tin_man").rglob("*.*")
    }
    package = {f"tin_man/{name}" for name in ("__init__.py", "robot.py", "tasks.py", "tin_man.xml")}
    assert files == package | {"pyproject.toml", "README.md", "tests/test_tin_man.py"}
    for file in (work / "tin_man").rglob("*.py"):
        ast.parse(file.read_text())
        assert "$" not in file.read_text()
    declared = tomllib.loads((work / "tin_man" / "pyproject.toml").read_text())["project"][
        "entry-points"
    ]
    assert declared == {"ksim_rl.tasks": {"tin_man": "tin_man.tasks"}}
    readme = (work / "tin_man" / "README.md").read_text()
    assert "--plugin tin_man task=tin_man_velocity_flat" in readme and "stands for 5 s" in readme
    assert "next: cd tin_man" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["tin_man.xml", "--name", "Tin-Man"],
            "--name Tin-Man: expected a name for a Python package",
        ),
        (["tin_man.xml", "--name", "numpy"], "a Python package of this name is installed already"),
        (
            ["tin_man.xml", "--name", "quadruped"],
            "there is a task 'quadruped_velocity_flat' already",
        ),
        (["tin_man.xml", "--output", "."], "exists already"),
        (["nowhere.xml"], "nowhere.xml"),
        (["tin_man.xml", "--pose", "home"], "the model has no pose 'home': valid: qpos0"),
    ],
)
def test_what_cannot_be_written_is_one_line_and_leaves_nothing(work, capsys, arguments, message):
    assert run("new", "robot", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("ksim-rl: error") == 1
    assert [path.name for path in work.iterdir()] == ["tin_man.xml"]


def test_a_model_is_copied_with_what_it_includes_and_its_meshes(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "new").mkdir()
    corners = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    (tmp_path / "meshes" / "part.obj").write_text(corners)
    included = '<mujocoinclude><asset><mesh name="part" file="part.obj"/></asset></mujocoinclude>'
    (tmp_path / "assets.xml").write_text(included)
    (tmp_path / "robot.xml").write_text(
        '<mujoco><compiler meshdir="meshes"/><include file="assets.xml"/><worldbody>'
        '<body><freejoint/><geom type="mesh" mesh="part" mass="1"/></body></worldbody></mujoco>'
    )
    copy_model(tmp_path / "robot.xml", tmp_path / "new" / "own.xml")
    for path in (tmp_path / "meshes").iterdir():
        path.unlink()
    (tmp_path / "assets.xml").unlink()
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "new" / "own.xml")).nmesh == 1


def test_files_of_one_name_in_two_folders_stay_two(tmp_path):
    (tmp_path / "new").mkdir()
    for folder, size in (("small", 0.1), ("large", 0.2)):
        (tmp_path / folder).mkdir()
        corners = f"v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nv 0 0 {size}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
        (tmp_path / folder / "part.obj").write_text(corners)
    meshes = '<mesh name="a" file="small/part.obj"/><mesh name="b" file="large/part.obj"/>'
    geoms = '<geom type="mesh" mesh="a"/><geom type="mesh" mesh="b"/>'
    (tmp_path / "robot.xml").write_text(
        f"<mujoco><asset>{meshes}</asset><worldbody><body><freejoint/>{geoms}</body></worldbody></mujoco>"
    )
    before = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    copy_model(tmp_path / "robot.xml", tmp_path / "new" / "own.xml")
    after = mujoco.MjModel.from_xml_path(str(tmp_path / "new" / "own.xml"))
    assert after.body_mass[1] == pytest.approx(before.body_mass[1])
    assert after.mesh_vert.max() == pytest.approx(before.mesh_vert.max())


@pytest.mark.full
@pytest.mark.parametrize(
    ("model", "name"), [("tin_man.xml", "tin_man"), ("unitree_a1/a1", "my_a1")]
)
def test_it_trains_at_once_and_its_own_test_passes(work, model, name):
    if "/" in model:
        from ksim_rl.physics import load_spec

        with skipped_without_models():
            load_spec(model)
    assert run("new", "robot", model, "--name", name) == 0
    command = [
        "-m",
        "ksim_rl.cli.main",
        "train",
        "--plugin",
        name,
        f"task={name}_velocity_flat",
        *QUICK.split(),
    ]
    trained = guide.run(*command, site=work / "site", cwd=work / name)
    assert trained.returncode == 0 and "2 iterations" in trained.stdout, (
        trained.stdout + trained.stderr
    )
    tested = guide.run("-m", "pytest", "-q", "tests", site=work / "site", cwd=work / name)
    assert tested.returncode == 0 and "2 passed" in tested.stdout, tested.stdout


def test_a_task_in_one_file_trains(work, monkeypatch, capsys):
    assert run("new", "task", "push_it") == 0
    assert "ksim-rl train --plugin push_it task=push_it" in capsys.readouterr().out
    text = (work / "push_it.py").read_text()
    ast.parse(text)
    assert "$" not in text
    monkeypatch.setattr(sys, "argv", ["ksim-rl"])
    settings = "num_envs=16 data.num_env_states_per_minibatch=64 data.num_minibatches=2 trainer.num_iterations=1"
    words = f"{settings} trainer.video=false trainer.eval_episodes=0 hydra.run.dir=run".split()
    assert run("train", "--plugin", "push_it", "task=push_it", *words) == 0
    assert (work / "run" / "metrics.csv").exists()


def test_a_task_needs_a_name_that_is_free(work, capsys):
    (work / "mine.py").write_text("")
    for name, message in (
        ("mine", "mine.py: exists already"),
        ("walker_walk", "there is a task 'walker_walk'"),
    ):
        assert run("new", "task", name) == 2
        assert message in capsys.readouterr().err
    assert run("new", "task", "Bad-Name") == 2
    assert "NAME Bad-Name: expected a name for a Python package" in capsys.readouterr().err
